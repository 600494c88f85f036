"""Movable objects in a plane: sliding against closed forms, pushing against MuJoCo, compiled as plain."""

import math

import numpy as np
import pytest
from numba_marks import with_numba

from khep_twin import playpen, units
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed, Network
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar import plane as plane_data
from khep_twin.episodes.planar.motion import step
from khep_twin.episodes.planar.planar_world import PlanarForms
from khep_twin.errors import PlaypenError
from khep_twin.playpen import Playpen

ARENA = """
version = 1
name = "pushing"
[arena]
width_mm = 700
height_mm = 700
[[robot]]
x_mm = 200
y_mm = 350
heading_deg = 0
"""


def cylinder(
    x_mm: float, y_mm: float, radius_mm: float = 15, mass_g: float = 20, height_mm: float = 30
) -> str:
    size = f"radius_mm = {radius_mm}\nheight_mm = {height_mm}\nmovable = true\nmass_g = {mass_g}\n"
    return f"[[cylinder]]\nx_mm = {x_mm}\ny_mm = {y_mm}\n{size}"


def block(
    x_mm: float,
    y_mm: float,
    length_mm: float = 30,
    width_mm: float = 30,
    angle_deg: float = 0,
    mass_g: float = 20,
) -> str:
    size = f"length_mm = {length_mm}\nwidth_mm = {width_mm}\nheight_mm = 30\nangle_deg = {angle_deg}\n"
    return f"[[block]]\nx_mm = {x_mm}\ny_mm = {y_mm}\n{size}movable = true\nmass_g = {mass_g}\n"


def arena(*objects: str) -> Playpen:
    return playpen.parse(ARENA + "".join(objects), "pushing")


def plane_of(*objects: str) -> tuple[PlanarForms, np.ndarray]:
    """Return a plane, and the table of its movable objects."""
    setup = EpisodeSetup(arena(*objects), planar=True)
    assert setup.planar_scene is not None
    forms = PlanarForms(setup.scene_model, setup.planar_scene)
    forms.place_robot(None)
    return forms, forms.compiled()[3]


def slide(forms: PlanarForms, bodies: np.ndarray, **speeds: float) -> None:
    """Let the first object slide until it sleeps."""
    for name, speed in speeds.items():
        bodies[0, getattr(plane_data, name.upper())] = speed
    bodies[0, plane_data.ACTIVE] = 1
    forms.state["last_step"][plane_data.SLIPS] = 1
    for _ in range(50):
        step(forms.plane)
    assert not bodies[0, [plane_data.ACTIVE, plane_data.SPEED_X, plane_data.SPEED_Y, plane_data.SPIN]].any()


def test_a_sliding_object_is_stopped_by_friction() -> None:
    forms, bodies = plane_of(cylinder(450, 350))
    slide(forms, bodies, speed_x=0.6, speed_y=-0.8)
    x, y, heading = forms.objects[0] - (0.45, 0.35, 0)
    # The friction between a movable object and the floor is MuJoCo's 1; a substep is up to 2.5 ms too short.
    assert math.hypot(x, y) == pytest.approx(1 / (2 * units.GRAVITY), abs=0.5 * units.STEP_NS * 1e-9)
    assert y / x == pytest.approx(-0.8 / 0.6)
    assert heading == 0


def test_a_spinning_box_is_stopped_by_the_friction_of_its_corners() -> None:
    forms, bodies = plane_of(block(450, 350, 60, 20))
    slide(forms, bodies, spin=8.0)
    inertia_per_mass, arm = (0.03**2 + 0.01**2) / 3, math.hypot(0.03, 0.01)
    angle = 8.0**2 * inertia_per_mass / (2 * units.GRAVITY * arm)
    assert forms.objects[0, 2] == pytest.approx(angle, abs=8.0 * units.STEP_NS * 1e-9 / 2)
    assert forms.objects[0, :2] == pytest.approx([0.45, 0.35])


PUSHED = {
    "a cylinder ahead": [cylinder(270, 352)],
    "a cylinder beside the middle": [cylinder(270, 358)],
    "a light cylinder": [cylinder(270, 353, mass_g=6)],
    "one that is too heavy": [cylinder(270, 350, 20, 90)],
    "a block": [block(272, 356)],
    "a turned block": [block(276, 350, 40, 30, 20)],
    "two, one behind the other": [cylinder(270, 350, mass_g=12), cylinder(304, 352, mass_g=12)],
    "two blocks": [block(270, 350, mass_g=12), block(304, 354, angle_deg=10, mass_g=12)],
}


@pytest.mark.share(2)
@pytest.mark.parametrize("case", PUSHED)
def test_pushing_in_the_plane_is_similar_to_that_in_mujoco(case: str) -> None:
    ends = []
    for planar in (False, True):
        setup = EpisodeSetup(arena(*PUSHED[case]), planar=planar)
        episode = Episode(setup, ConstantSpeed(10, 10), compiled=False)
        episode.begin(options=EpisodeOptions(noise=False))
        start = episode.objects
        episode.run(1.0)
        ends.append((np.array(episode.pose), episode.objects, np.hypot(*(episode.objects - start)[:, :2].T)))
    (true, true_objects, ways), (planar, objects, _) = ends
    assert planar[:2] == pytest.approx(true[:2], abs=1.5e-3)
    assert objects[:, :2] == pytest.approx(true_objects[:, :2], abs=4e-3)
    assert ways[0] < 1e-3 if "heavy" in case else ways[0] > 0.03


def test_objects_between_a_robot_and_a_wall_do_not_penetrate() -> None:
    forms, _ = plane_of(block(640, 350, mass_g=5), cylinder(604, 351, mass_g=5), cylinder(640, 100))
    forms.place_robot((545.0, 350.0, 0.0))
    forms.state["ctrl"][:] = 2.0
    for _ in range(200):
        step(forms.plane)
        (x, y, _), (box, can, far) = forms.pose, forms.objects
        corners = abs(math.cos(box[2])) + abs(math.sin(box[2]))
        assert box[0] + 0.015 * corners < 0.7 + 2e-3
        assert (
            plane_data.distance_to(
                forms.plane.obstacles, int(forms.plane.bodies[0, plane_data.OBSTACLE]), *can[:2]
            )
            > 0.013
        )
        assert math.hypot(can[0] - x, can[1] - y) > 0.015 + units.BODY_RADIUS - 2e-3
        assert far.tolist() == [0.64, 0.1, 0.0]
    assert forms.objects[0, 0] > 0.67


def test_a_pushed_object_is_seen_at_its_position() -> None:
    episode = Episode(
        EpisodeSetup(arena(cylinder(290, 350)), planar=True), ConstantSpeed(10, 10), compiled=False
    )
    episode.begin(options=EpisodeOptions(noise=False))
    free = max(episode.readings()[0])
    episode.run(1.3)
    assert free < 100
    assert max(episode.readings()[0][2:4]) > 500


@with_numba
def test_pushing_is_bitwise_equal_plain_and_compiled_and_after_other_episodes() -> None:
    objects = [
        cylinder(270, 352),
        block(304, 360, angle_deg=10),
        cylinder(150, 300, 10),
        block(400, 420, 60, 20, 40),
    ]
    network = Network(hidden=(3,))
    genes = np.random.default_rng(2).normal(size=(5, network.n_genes))
    results = [
        rollout(
            EpisodeSetup(arena(*objects), planar=True),
            network,
            range(5),
            4.0,
            genes=genes,
            compiled=compiled,
            threads=threads,
        )
        for compiled, threads in ((False, 1), (True, 1), (True, 3))
    ]
    for result in results[1:]:
        assert result.objects.tolist() == results[0].objects.tolist()
        assert result.poses.tolist() == results[0].poses.tolist()
        assert result.registers.tolist() == results[0].registers.tolist()
    assert len(np.unique(results[0].objects[:, 0, 0])) > 1


@pytest.mark.parametrize(
    ("part", "size"),
    [
        (cylinder(300, 300, 7), "14 mm wide and 30 mm high"),
        (cylinder(300, 300, 10, 20, 70), "20 mm wide and 70 mm"),
    ],
)
def test_an_object_that_would_tip_over_is_refused(part: str, size: str) -> None:
    with pytest.raises(
        PlaypenError, match=f"cylinder 1 is movable, {size}.*expected a width of at least 16 mm"
    ):
        EpisodeSetup(arena(part), planar=True)


def test_objects_equal_those_of_mujoco_in_the_playpens_order() -> None:
    objects = [block(500, 400, angle_deg=30), cylinder(300, 300)]
    result = rollout(arena(*objects), Braitenberg(), [1], 0.02, compiled=False)
    assert result.objects[0] == pytest.approx(
        np.array([[0.5, 0.4, math.radians(30)], [0.3, 0.3, 0]]), abs=1e-6
    )
