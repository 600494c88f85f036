"""Episodes in a batch: bitwise equal to single ones, and their failures."""

import numpy as np
import pytest
from numba_marks import KINDS

from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_batch import EpisodeBatch
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Playpen

PERIOD_NS = 50_000_000


def speeds(n_steps: int, count: int) -> np.ndarray:
    """Return random speeds (n_steps, count, 1, 2)."""
    return np.random.default_rng(0).uniform(-5, 20, (n_steps, count, 1, 2))


def run_batch(setup: EpisodeSetup, count: int, n_steps: int, threads: int, compiled: bool) -> EpisodeBatch:
    """Run a batch, in every other step without the first slot; return it."""
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for _ in range(count)], threads)
    for index in range(count):
        batch.begin(index, index, EpisodeOptions(vary=True))
    for number, step_speeds in enumerate(speeds(n_steps, count)):
        slots = np.arange(count)[number % 2 :]
        batch.speeds[:] = step_speeds
        assert batch.step(slots, setup.steps_per_period) == {}
    batch.close()
    return batch


def assert_equal_to_single(setup: EpisodeSetup, batch: EpisodeBatch, n_steps: int) -> None:
    for index, batched in enumerate(batch.episodes):
        single = Episode(setup, compiled=False)
        single.begin(index, EpisodeOptions(vary=True))
        for number, step_speeds in enumerate(speeds(n_steps, len(batch.episodes))):
            if index >= number % 2:
                single.drive(*step_speeds[index, 0])
                single.step(setup.steps_per_period)
        assert single.boards.tolist() == batch.registers[index].tolist() == batched.boards.tolist()
        assert single.joints.tolist() == batched.joints.tolist()
        assert single.metrics() == batched.metrics() or np.isnan(single.metrics()["homing"])
        assert batch.poses[index, 0] == pytest.approx(single.pose, abs=1e-12)


@pytest.mark.share(2)
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("planar", [False, True])
def test_episodes_in_a_batch_equal_single_ones(planar: bool, compiled: bool, threads: int) -> None:
    setup = EpisodeSetup(Playpen.load("obstacles"), period_ns=PERIOD_NS, planar=planar)
    assert_equal_to_single(setup, run_batch(setup, 4, 6, threads, compiled), 6)


def blinking() -> Playpen:
    scene = Playpen.load("two-lamps")
    lamp, *other_lamps = scene.lamps
    return scene.model_copy(update={"lamps": (lamp.model_copy(update={"blink_period_s": 0.1}), *other_lamps)})


def nearly_empty() -> Playpen:
    scene = Playpen.load("default")
    robot = scene.robots[0].model_copy(update={"battery_used_min": 40.9705})
    return scene.model_copy(update={"robots": (robot,)})


@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("scene", [blinking, nearly_empty])
def test_blinking_lamps_and_a_stopped_processor_are_the_same_in_a_batch(
    scene: object, compiled: bool
) -> None:
    setup = EpisodeSetup(scene(), period_ns=PERIOD_NS)  # type: ignore[operator]
    assert_equal_to_single(setup, run_batch(setup, 2, 6, 1, compiled), 6)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("compiled", KINDS)
def test_episodes_of_different_playpens_in_a_batch_equal_single_ones(compiled: bool, threads: int) -> None:
    names = ("obstacles", "two-lamps", "obstacles", "default")
    setups = [EpisodeSetup(name, period_ns=PERIOD_NS, planar=True) for name in names]
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for setup in setups], threads)
    for index in range(4):
        batch.begin(index, index, EpisodeOptions(noise=index != 2))
    # Another episode replaces one that was started.
    setups[0] = setups[3]
    batch.begin(0, 0, episode=Episode(setups[0], compiled=compiled))
    for step_speeds in speeds(6, 4):
        batch.speeds[:] = step_speeds
        assert batch.step(np.arange(4), PERIOD_NS // setups[0].step_ns) == {}
    batch.close()
    assert not compiled or batch._runs_compiled.all()
    for index, setup in enumerate(setups):
        single = Episode(setup, compiled=False)
        single.begin(index, EpisodeOptions(noise=index != 2))
        for step_speeds in speeds(6, 4):
            single.drive(*step_speeds[index, 0])
            single.step(setup.steps_per_period)
        assert single.boards.tolist() == batch.registers[index].tolist()
        assert batch.poses[index, 0] == pytest.approx(single.pose, abs=1e-12)


@pytest.mark.parametrize("compiled", KINDS)
def test_a_speed_that_is_not_finite_is_the_failure_of_one_episode(compiled: bool) -> None:
    setup = EpisodeSetup(Playpen.load("obstacles"), period_ns=PERIOD_NS, planar=True)
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for _ in range(3)], 1)
    for index in range(3):
        batch.begin(index, index)
    batch.speeds[1] = np.nan
    [(slot, failure)] = batch.step(np.arange(3), setup.steps_per_period).items()
    assert slot == 1
    assert "episode of seed 1 failed" in str(failure)
    assert "expected finite numbers" in str(failure)
    assert [episode.time_ns for episode in batch.episodes] == [PERIOD_NS, 0, PERIOD_NS]
    batch.speeds[:] = 5
    assert batch.step(np.arange(3), setup.steps_per_period) == {}
    assert [episode.time_ns for episode in batch.episodes] == [2 * PERIOD_NS, PERIOD_NS, 2 * PERIOD_NS]
