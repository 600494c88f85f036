"""Robots fitted to another calibration: equal to the scene compiled from it, and reversible."""

import copy
from typing import Any

import mujoco
import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen
from khep_twin.sensing import calibration
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.fitted_robots import FIELDS, CalibratedRobots
from khep_twin.simulation.mujoco_forms import SceneModel
from khep_twin.world import World

SECOND = "[[robot]]\nx_mm = 150\ny_mm = 150\nheading_deg = 90\n"
OPEN = """
version = 1
name = "open"
[arena]
width_mm = 2000
height_mm = 2000
[[robot]]
x_mm = 1000
y_mm = 1000
heading_deg = 0
"""

LEFT_OUT = {"meansize", "actuator_biasprm"}
"""The visualisation scale, and the damping of a gripper's servos."""


def two() -> Playpen:
    return playpen.parse(playpen.dump(Playpen.load("default")) + SECOND, "two")


def sample_robot(seed: int = 0) -> Calibration:
    return calibration.vary(calibration.read("khepera1")[0], np.random.default_rng(seed))


def replace(patch: pytest.MonkeyPatch, name: str, value: object) -> None:
    """Replace a function of `calibration` by one that returns this value."""

    def answer(*_: object) -> object:
        return value

    patch.setattr(calibration, name, answer)


def numbers(model: mujoco.MjModel) -> dict[str, Any]:
    """Return all arrays of a model, and its statistics."""
    values: dict[str, Any] = {}
    for part in (model, model.stat):
        for name in dir(part):
            value = getattr(part, name) if not name.startswith("_") else None
            if isinstance(value, (np.ndarray, float, int)) and name not in LEFT_OUT:
                values[name] = np.array(value)
    return values


def same(first: mujoco.MjModel, second: mujoco.MjModel) -> bool:
    left, right = numbers(first), numbers(second)
    # The static deflection of the tyres is computed differently in a fitted scene.
    if np.allclose(left["pair_margin"], right["pair_margin"], rtol=1e-9, atol=0):
        left["pair_margin"] = right["pair_margin"]
    different = {
        name
        for name, value in left.items()
        if not np.array_equal(value, right[name], equal_nan=value.dtype.kind == "f")
    }
    assert not different - {*FIELDS, "meaninertia"}
    return not different


@pytest.mark.parametrize("name", ["obstacles", "garbage", "two"])
def test_a_fitted_scene_is_the_one_compiled_of_that_calibration_and_can_be_undone(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = two() if name == "two" else Playpen.load(name)
    model = SceneModel.of(scene).model
    before, drawn = copy.copy(model), sample_robot()
    robots = [RobotIndices.of(model, f"khepera{index}") for index in range(len(scene.robots))]
    fitted, data = CalibratedRobots(model, robots), mujoco.MjData(model)
    fitted.set_calibrations([sample_robot(1)] * len(robots), data)
    fitted.set_calibrations([drawn] * len(robots), data)
    assert not same(model, before)
    with monkeypatch.context() as patched:
        replace(patched, "read", (drawn, ""))
        replace(patched, "read_for", drawn)
        assert same(model, SceneModel.of(scene).model)
    fitted.set_calibrations(None, data)
    assert same(model, before)


def test_a_world_that_has_varied_returns_to_its_own_robot() -> None:
    world, untouched = World(two(), seed=1), World(two(), seed=1)
    world.reset(2, vary=True)
    assert not same(world.model, untouched.model)
    world.reset(1)
    for driven in (world, untouched):
        for robot in driven.robots:
            robot.send(b"D,5,7\n")
        driven.advance_to(1_000_000_000)
    # LEDs that are lit differ from a model as compiled, but not between these two.
    assert same(world.model, untouched.model)
    assert world.data.qpos.tobytes() == untouched.data.qpos.tobytes()


def test_a_restart_with_vary_is_a_new_world_with_vary() -> None:
    world, new = World(two(), seed=1), World(two(), seed=2, vary=True)
    world.reset(3, vary=True)
    world.reset(2, vary=True)
    assert same(world.model, new.model)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("compiled", [False, True])
def test_an_episode_that_varies_leaves_the_shared_model_as_it_is(compiled: bool, planar: bool) -> None:
    if compiled:
        pytest.importorskip("numba")
    setup = EpisodeSetup(Playpen.load("default"), planar=planar)
    before = copy.copy(setup.scene_model.model)
    episode = Episode(setup, compiled=compiled)
    ends: list[bytes] = []
    for vary in (False, True, False):
        episode.begin(1, EpisodeOptions(vary=vary))
        episode.drive(5, 5)
        episode.run(0.5)
        ends.append(episode.joints.tobytes())
    assert ends[0] == ends[2] != ends[1]
    assert same(setup.scene_model.model, before)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_another_robot_of_the_same_make_sees_the_same_in_the_plane(seed: int) -> None:
    readings: list[list[list[int]]] = []
    for planar, vary in ((False, True), (True, True), (False, False)):
        episode = Episode(EpisodeSetup(Playpen.load("two-lamps"), planar=planar), compiled=False)
        episode.begin(seed, EpisodeOptions(start=(45.0, 300.0, 170.0), noise=False, vary=vary))
        readings.append(list(episode.readings()))
    assert np.abs(np.subtract(readings[0], readings[1])).max() <= 1
    assert np.abs(np.subtract(readings[0], readings[2])).max() > 20


@pytest.mark.parametrize("planar", [False, True])
def test_wheels_drive_as_far_as_their_radii_and_turn_by_their_difference(
    planar: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Equal counts give an arc: heading = (right - left) / base, by the difference of the radii."""
    measured = calibration.read("khepera1")[0]
    wheels = measured.wheels.model_copy(update={"radius_mm": 7.8, "right_over_left": 1.02, "base_mm": 53.0})
    drawn = measured.model_copy(update={"wheels": wheels})
    replace(monkeypatch, "vary", drawn)
    episode = Episode(EpisodeSetup(playpen.parse(OPEN, "open"), planar=planar), compiled=False)
    episode.begin(options=EpisodeOptions(noise=False, vary=True))
    episode.drive(10, 10)
    episode.run(2.0)
    x, y, heading = episode.pose
    left, right = episode.joints[[3, 4] if planar else [7, 8]].tolist()
    assert left == pytest.approx(right, rel=2e-4)
    length = (left + right) / 2 * 7.8e-3
    turn = (right * 7.8e-3 * 1.02 - left * 7.8e-3) * 2 / 2.02 / 0.053
    assert heading == pytest.approx(turn, rel=3e-3)
    assert np.hypot(x - 1, y - 1) == pytest.approx(length * np.sinc(turn / 2 / np.pi), rel=1e-3)
