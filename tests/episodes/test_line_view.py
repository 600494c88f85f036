"""The line image in a plane equals that of MuJoCo's scene."""

import mujoco
import numpy as np
import pytest
from numba_marks import KINDS

from khep_twin import playpen as playpens
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.planar.line_view import PlaneView
from khep_twin.episodes.planar.planar_world import PlanarWorld
from khep_twin.playpen import Playpen
from khep_twin.sensing.line_faces import fixed_faces, moving_faces, read_poses
from khep_twin.sensing.line_scene import Eye
from khep_twin.units import K213_EYE_AHEAD, K213_EYE_HEIGHT
from khep_twin.vision.camera import LineCamera
from khep_twin.world import World
from tests.vision.seen import block, cylinder, lamp

LAMP = (0.2, 0.4, 0.015, 4.0)


def bare(parts: str) -> Playpen:
    arena = "[arena]\nwidth_mm = 600\nheight_mm = 500\n" + 'stripes = [[31, "black"], [47, "white"]]\n'
    text = f'version = 1\nname = "p"\n{arena}{parts}'
    return playpens.parse(text + "[[robot]]\nx_mm = 200\ny_mm = 250\nheading_deg = 10\n", "p.toml")


PARTS = (
    block(450, 330, 40, surface="wood")
    + cylinder(520, 180, 20)
    + 'stripes = [[12, "grey"], [9, "white"]]\nmovable = true\nmass_g = 20\n'
    + lamp(200, 400, 4, z_mm=15)
)


def test_the_lens_is_at_its_position_on_the_turret() -> None:
    world = World(Playpen.load("stripes"), noise=False)
    mujoco.mj_kinematics(world.model, world.data)
    mujoco.mj_camlight(world.model, world.data)
    x, _, height = world.data.cam_xpos[world.model.camera("khepera0/k213/eye").id].tolist()
    assert (x - world.robots[0].pose[0], height) == pytest.approx((K213_EYE_AHEAD, K213_EYE_HEIGHT), abs=1e-5)


@pytest.mark.parametrize("compiled", KINDS)
def test_the_image_in_a_plane_equals_that_in_mujoco(compiled: bool) -> None:
    setup = EpisodeSetup(bare(PARTS), planar=True)
    assert setup.planar_scene is not None
    world = PlanarWorld(setup.scene_model, setup.planar_scene)
    world.reset(0, noise=False)
    view, model = PlaneView(world.playpen, setup.model, world.forms.plane), setup.model
    for start in ((200, 250, 10), (330, 120, -25), (350, 300, 80)):
        world.reset(0, noise=False, starts=[start])
        pixels, expected = np.zeros(64, np.int64), np.zeros(64, np.int64)
        light = view.take(pixels, [LAMP], 300.0, compiled=compiled)
        data = mujoco.MjData(model)
        x, y, heading = world.forms.pose
        data.qpos[setup.indices.pose : setup.indices.pose + 2] = x, y
        data.qpos[setup.indices.pose + 3 : setup.indices.pose + 7] = (
            np.cos(heading / 2),
            0,
            0,
            np.sin(heading / 2),
        )
        mujoco.mj_kinematics(model, data)
        c, s = np.cos(heading), np.sin(heading)
        eye = Eye(x + K213_EYE_AHEAD * c, y + K213_EYE_AHEAD * s, K213_EYE_HEIGHT, c, s)
        camera = LineCamera(fixed_faces(model), moving_faces(model, setup.indices.base), read_poses(data))
        assert camera.take(eye, expected, [LAMP], 300.0, 0, (0, 0), 0, noise=False) == light
        assert np.abs(pixels - expected).max() <= 1
        assert expected.max() - expected.min() > 100


def test_a_pushed_object_is_seen_at_its_new_position() -> None:
    pushed = cylinder(260, 250, 20) + "movable = true\nmass_g = 20\n"
    text = bare(pushed)
    robots = (text.robots[0].model_copy(update={"heading_deg": 0.0}),)
    setup = EpisodeSetup(text.model_copy(update={"robots": robots}), planar=True)
    assert setup.planar_scene is not None
    world = PlanarWorld(setup.scene_model, setup.planar_scene)
    world.reset(0, noise=False)
    view, images = PlaneView(world.playpen, setup.model, world.forms.plane), np.zeros((2, 64), np.int64)
    view.take(images[0], [], 300.0)
    world.forms.plane.obstacles[len(world.forms._fixed_by_distance), 1] += 0.1  # its centre, to the left
    view.take(images[1], [], 300.0)
    assert (images[0, 20:44] < 20).all()
    assert not (images[1, 20:44] < 20).all()
