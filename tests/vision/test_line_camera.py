"""A line camera by plain and compiled code, in playpens with all kinds of movable objects."""

from typing import Any

import numpy as np
import pytest
from numba_marks import with_numba

from khep_twin.board.k213 import PIXELS, K213Register
from khep_twin.playpen import Playpen
from khep_twin.simulation.ready import function_of
from khep_twin.vision.camera import LineCamera, eye_of
from khep_twin.world import World
from tests.vision.seen import block, cylinder, image, lamp, registers, world

CROWD = (
    block(405, 290, 40, surface="wood")
    + 'stripes = [[7, "black"], [9, "white"]]\nmovable = true\nangle_deg = 20\n'
    + cylinder(430, 220, 12)
    + 'stripes = [[11, "grey"], [6, "white"]]\nmovable = true\n'
    + cylinder(520, 150, 20)
    + lamp(560, 440, 1)
    + lamp(200, 400, 4, z_mm=15)
    + '[[robot]]\nx_mm = 500\ny_mm = 250\nheading_deg = 130\nturrets = ["k213"]\n'
)
ARENA = 'stripes = [[31, "black"], [47, "white"]]\n'


def camera_of(scene: World, robot: int) -> LineCamera:
    body = scene.robots[robot].turret_bodies["k213"]
    return body._camera  # type: ignore[attr-defined]


@pytest.mark.share(2)
@with_numba
@pytest.mark.parametrize("noise", [True, False])
def test_plain_and_compiled_code_take_the_same_image(noise: bool) -> None:
    scene = world(CROWD, arena=ARENA, noise=noise, compiled=False)
    capture = function_of("vision")
    for robot in (0, 1):
        scene.robots[robot].send(b"D,%d,%d\n" % (3 - robot, robot - 4))
    for step in range(12):
        scene.advance_to(scene.time_ns + 130_000_000)
        for robot in (0, 1):
            body: Any = scene.robots[robot].turret_bodies["k213"]
            camera, eye = camera_of(scene, robot), eye_of(scene.data, body._eye_camera)
            plain, compiled = np.zeros(64, np.int64), np.zeros(64, np.int64)
            arguments = body._context.lamps, 300.0, 50 * (step % 3), body._context.key, step
            light = camera.take(eye, plain, *arguments, noise=noise)
            camera._compiled = capture
            assert camera.take(eye, compiled, *arguments, noise=noise, compiled=True) == light
            camera._compiled = None
            assert compiled.tolist() == plain.tolist()
            assert len(set(plain.tolist())) > 5


@with_numba
def test_a_world_with_compiled_code_sees_the_same() -> None:
    images: list[list[int]] = []
    for compiled in (False, True):
        scene = world(CROWD, arena=ARENA, noise=True, compiled=compiled, seed=3)
        scene.robots[0].send(b"D,2,-2\n")
        if compiled:
            camera_of(scene, 0)._compiled = camera_of(scene, 1)._compiled = function_of("vision")
        images.append(np.array([image(scene) for _ in range(5)]).ravel().tolist())
        assert (camera_of(scene, 0)._compiled is None) != compiled
    assert images[0] == images[1]


def test_stripes_on_what_moves_move_with_it() -> None:
    striped = 'stripes = [[3, "black"], [3, "white"]]\nmovable = true\nmass_g = 20\n'
    scene = world(block(372, 250, 60, surface="white") + striped)
    before = image(scene)
    scene.robots[0].send(b"D,10,10\n")
    # It pushes the block, whose distance stays the same.
    image(scene, scans=4)
    pushed = image(scene)
    assert scene.robots[0].pose[0] > 0.36
    stripes = [np.count_nonzero(np.diff(pixels > 100)) for pixels in (before, pushed)]
    assert stripes[0] > 1
    assert stripes[1] > 1


def test_what_is_moved_in_the_model_is_seen_where_it_is() -> None:
    scene = world(block(450, 250, 30))
    assert (image(scene)[28:36] < 20).all()
    scene.model.geom_pos[scene.model.geom("block0").id, 1] += 0.1
    scene.refresh()
    assert (image(scene)[28:36] > 150).all()


def test_the_same_seed_sees_the_same_and_another_one_other_noise() -> None:
    first, second, other = (image(world(CROWD, noise=True, seed=seed)) for seed in (1, 1, 2))
    assert (first == second).all()
    assert not (first == other).all()


def test_two_robots_have_noise_of_their_own() -> None:
    twins = "[[robot]]\nx_mm = 300\ny_mm = 400\nheading_deg = 0\nturrets = ['k213']\n"
    scene = world(twins, noise=True)
    image(scene)
    first, second = (registers(scene, robot)[PIXELS] for robot in (0, 1))
    assert not (first == second).all()


def test_a_snapshot_goes_on_amid_a_scan_as_if_nothing_had_been() -> None:
    scene = world(CROWD, noise=True)
    scene.robots[0].send(b"T,2,U,3\nD,2,-2\n")
    scene.advance_to(430_000_000)
    assert registers(scene)[K213Register.LEFT] not in (0, registers(scene)[K213Register.SCAN])
    snapshot = scene.snapshot()
    scene.advance_to(1_500_000_000)
    other = world(CROWD, noise=True)
    other.restore(snapshot)
    other.advance_to(1_500_000_000)
    for robot in (0, 1):
        assert registers(other, robot).tolist() == registers(scene, robot).tolist()
    assert other.snapshot() == scene.snapshot()


def test_lamps_that_are_switched_are_seen_so() -> None:
    scene = world(lamp(500, 250, 1))
    assert image(scene)[32] == 255
    scene.lamps.switch(0, False, scene.time_ns)
    assert image(scene)[32] < 255


def test_the_shipped_playpen_shows_its_stripes() -> None:
    scene = World(Playpen.load("stripes"), noise=False)
    pixels = image(scene)
    assert np.count_nonzero(np.diff(pixels > 100)) > 4
