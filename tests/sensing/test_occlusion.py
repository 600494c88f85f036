"""Precomputed lines of sight: rays confirm every clear one, and many are clear."""

import math

import mujoco
import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT
from khep_twin.playpen import Playpen
from khep_twin.sensing import light as lamp_light
from khep_twin.sensing.ambient import build_light
from khep_twin.sensing.mujoco_scene import bulb_points, upright_shape
from khep_twin.sensing.occlusion import SightLines
from khep_twin.sensing.scene import FINE
from khep_twin.units import SENSOR_HEIGHT
from khep_twin.world import World


def share_of_clear(text: str, n: int = 400) -> float:
    """Check by rays that lamps with a clear line of sight are fully visible; return the clear share."""
    world = World(playpen.parse(text, "sight"), noise=False)
    sight_lines = SightLines(world.model, world.robots[0].indices, world.lamps.positions)
    light, plain = build_light(sight_lines, playpen.Lighting()), world.simulation.plain
    sensors = plain.groups[0][0].sensors
    position = world.data.cam_xpos[sensors.cameras[0]]
    width, depth = world.playpen.arena.width_mm / 1e3, world.playpen.arena.height_mm / 1e3
    n_clear = 0
    for x, y in np.random.default_rng(7).uniform((0, 0), (width, depth), (n, 2)).tolist():
        for lamp, bulb in enumerate(world.lamps.positions):
            if lamp_light.is_clear(light, lamp, x, y):
                n_clear += 1
                position[:] = x, y, SENSOR_HEIGHT
                ray = bulb[0] - x, bulb[1] - y, bulb[2] - SENSOR_HEIGHT
                distance = float(np.linalg.norm(ray))
                if distance > 0.03:
                    assert lamp_light.sample_bulb(plain.scene, sensors, 0, ray, distance, FINE) == 1, (
                        x,
                        y,
                        lamp,
                    )
    return n_clear / n / len(world.lamps.positions)


@pytest.mark.parametrize("name", ["default", "obstacles", "two-lamps", "light-seeking", "t-maze"])
def test_where_a_line_is_clear_rays_reach_all_of_the_bulb(name: str) -> None:
    text = playpen.dump(Playpen.load(name))
    if "[[lamp]]" not in text:
        text += "[[lamp]]\nx_mm = 100\ny_mm = 100\npower_w = 1\n"
    # The sign of the T-maze touches a wall, which may hide it in all directions.
    assert share_of_clear(text) >= (0 if name == "t-maze" else 0.4)


def test_things_in_all_directions_and_sizes_are_seen() -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        text = 'version = 1\nname = "many"\n[arena]\nwidth_mm = 800\nheight_mm = 600\n'
        text += "[[robot]]\nx_mm = 30\ny_mm = 30\nheading_deg = 0\n"
        for x, y, length, angle in rng.uniform((80, 80, 5, -180), (760, 560, 90, 180), (6, 4)).tolist():
            text += (
                f"[[block]]\nx_mm = {x}\ny_mm = {y}\nlength_mm = {length}\nwidth_mm = 8\nheight_mm = 50\n"
                f"angle_deg = {angle}\n"
                f"[[cylinder]]\nx_mm = {y}\ny_mm = {x * 0.7}\nradius_mm = {length / 4}\nheight_mm = 50\n"
            )
        for x, y in rng.uniform((10, 10), (790, 590), (3, 2)).tolist():
            text += f"[[lamp]]\nx_mm = {x}\ny_mm = {y}\npower_w = 1\nz_mm = 40\n"
        assert share_of_clear(text, 200) > 0.02


@pytest.mark.parametrize(
    "other",
    [
        "[[robot]]\nx_mm = 500\ny_mm = 400\nheading_deg = 0\n",
        "[[cylinder]]\nx_mm = 500\ny_mm = 400\nradius_mm = 9\nheight_mm = 50\nmovable = true\n",
    ],
)
def test_where_something_may_move_nothing_is_known(other: str) -> None:
    text = playpen.dump(Playpen.load("default")) + "[[lamp]]\nx_mm = 100\ny_mm = 100\npower_w = 1\n"
    assert share_of_clear(text, 50) == 1
    assert share_of_clear(text + other, 50) == 0


@pytest.mark.parametrize(
    ("channel", "to_bulb"),
    [
        (6, (0.01727616, -0.02480710, 0.01669987)),
        (5, (-0.03669416, -0.02120774, 0.01989215)),
        (7, (0.00252933, -0.05930577, 0.01243789)),
    ],
)
def test_corners_of_the_gripper_beside_a_sensor_stop_light(
    channel: int, to_bulb: tuple[float, float, float]
) -> None:
    world = World(Playpen.load("gripper"), noise=False, compiled=False)
    world.advance_to(100_000_000)
    model, data = world.model, world.data
    scene, sensors = world.simulation.plain.scene, world.simulation.plain.groups[0][0].sensors
    origin, distance = data.cam_xpos[sensors.cameras[channel]], float(np.linalg.norm(to_bulb))
    (x, y, z), horizontal = to_bulb, math.hypot(*to_bulb[:2])
    left, up = (
        np.array((-y / horizontal, x / horizontal, 0)),
        np.array((-x * z / horizontal, -y * z / horizontal, horizontal)) / distance,
    )
    is_obstacle = (model.geom_bodyid != sensors.base) & (model.geom_rgba[:, 3] > 0)
    n_blocked = 0
    for across, upward in bulb_points(FINE):
        ray = np.array(to_bulb) + lamp_light.BULB_RADIUS * (across * left + upward * up)
        hits = [
            mujoco.mju_rayGeom(
                data.geom_xpos[geom],
                data.geom_xmat[geom],
                model.geom_size[geom],
                origin,
                ray,
                model.geom_type[geom],
            )
            for geom in np.flatnonzero(is_obstacle)
        ]
        n_blocked += any(0 <= hit < 1 - lamp_light.BULB_RADIUS / distance for hit in hits)
    assert lamp_light.sample_bulb(scene, sensors, channel, to_bulb, distance, FINE) == 1 - n_blocked / 64
    assert n_blocked in (1, 2, 55)


@pytest.mark.parametrize("bulb", ["x_mm = 620\ny_mm = 500\nz_mm = 3", "x_mm = 999\ny_mm = 500"])
def test_a_bulb_within_floor_or_wall_has_the_same_light_beside_what_can_move(bulb: str) -> None:
    arena = 'version = 1\nname = "a"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n'
    robot = "[[robot]]\nx_mm = 500\ny_mm = 500\nheading_deg = 0\n"
    movable = (
        "[[cylinder]]\nx_mm = 60\ny_mm = 60\nradius_mm = 10\nheight_mm = 20\nmass_g = 20\nmovable = true\n"
    )
    text = f"{arena}{robot}[[lamp]]\npower_w = 1\n{bulb}\n"
    readings: list[list[int]] = []
    for scene in (text, text + movable):
        world = World(playpen.parse(scene, "bulb"), noise=False)
        world.advance_to(200_000_000)
        readings.append([int(count) for count in world.robots[0].registers[AMBIENT]])
    assert readings[0] == readings[1]


TILTS = {0: np.eye(3), 1: np.roll(np.eye(3), 1, axis=0), 2: np.roll(np.eye(3), 2, axis=0)}
"""Rotations by the axis of a box that points upwards along z: 2 steps, 0 or 1."""


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_box_on_any_of_its_sides_is_the_upright_box_that_it_looks_like(steps: int) -> None:
    size, position = np.array([0.01, 0.02, 0.03]), (0.4, 0.5, 0.1)
    for angle in np.linspace(-3, 3, 7).tolist():
        turn = np.array(
            [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]]
        )
        rotation = turn @ TILTS[steps]
        box = int(mujoco.mjtGeom.mjGEOM_BOX)
        centre, direction, (half, width), span = upright_shape(
            box, size.tolist(), position, rotation.ravel().tolist()
        )
        corners = rotation @ (size * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T).T
        along, across = np.array([direction, (-direction[1], direction[0])]) @ corners[:2]
        assert centre == position[:2]
        np.testing.assert_allclose([np.hypot(*direction), along.max(), across.max()], [1, half, width])
        np.testing.assert_allclose(span, (0.1 + corners[2].min(), 0.1 + corners[2].max()))
