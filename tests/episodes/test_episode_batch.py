"""Episodes side by side: the results of the single ones, bit for bit, and their failures."""

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


def together(setup: EpisodeSetup, count: int, n_steps: int, threads: int, compiled: bool) -> EpisodeBatch:
    """Return episodes that have run side by side; every other step only some of them."""
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for _ in range(count)], threads)
    for index in range(count):
        batch.begin(index, index, EpisodeOptions(vary=True))
    for number, each in enumerate(speeds(n_steps, count)):
        rows = np.arange(count)[number % 2 :]
        batch.speeds[:] = each
        assert batch.step(rows, setup.steps_per_period) == {}
    batch.close()
    return batch


def assert_alone_the_same(setup: EpisodeSetup, batch: EpisodeBatch, n_steps: int) -> None:
    for index, other in enumerate(batch.episodes):
        alone = Episode(setup, compiled=False)
        alone.begin(index, EpisodeOptions(vary=True))
        for number, each in enumerate(speeds(n_steps, len(batch.episodes))):
            if index >= number % 2:
                alone.drive(*each[index, 0])
                alone.step(setup.steps_per_period)
        assert alone.boards.tolist() == batch.registers[index].tolist() == other.boards.tolist()
        assert alone.joints.tolist() == other.joints.tolist()
        assert alone.metrics() == other.metrics() or np.isnan(alone.metrics()["homing"])
        assert batch.poses[index, 0] == pytest.approx(alone.pose, abs=1e-12)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("planar", [False, True])
def test_episodes_side_by_side_are_the_same_as_alone(planar: bool, compiled: bool, threads: int) -> None:
    setup = EpisodeSetup(Playpen.load("obstacles"), period_ns=PERIOD_NS, planar=planar)
    assert_alone_the_same(setup, together(setup, 4, 6, threads, compiled), 6)


def blinking() -> Playpen:
    scene = Playpen.load("two-lamps")
    first, *others = scene.lamps
    return scene.model_copy(update={"lamps": (first.model_copy(update={"blink_period_s": 0.1}), *others)})


def nearly_empty() -> Playpen:
    scene = Playpen.load("default")
    robot = scene.robots[0].model_copy(update={"battery_used_min": 40.9705})
    return scene.model_copy(update={"robots": (robot,)})


@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("scene", [blinking, nearly_empty])
def test_lamps_that_blink_and_a_processor_that_stops_are_the_same_side_by_side(
    scene: object, compiled: bool
) -> None:
    setup = EpisodeSetup(scene(), period_ns=PERIOD_NS)  # type: ignore[operator]
    assert_alone_the_same(setup, together(setup, 2, 6, 1, compiled), 6)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("compiled", KINDS)
def test_episodes_of_different_playpens_side_by_side_are_the_same_as_alone(
    compiled: bool, threads: int
) -> None:
    names = ("obstacles", "two-lamps", "obstacles", "default")
    setups = [EpisodeSetup(name, period_ns=PERIOD_NS, planar=True) for name in names]
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for setup in setups], threads)
    for index in range(4):
        batch.begin(index, index, EpisodeOptions(noise=index != 2))
    # Another episode takes the place of one that has begun.
    setups[0] = setups[3]
    batch.begin(0, 0, episode=Episode(setups[0], compiled=compiled))
    for each in speeds(6, 4):
        batch.speeds[:] = each
        assert batch.step(np.arange(4), PERIOD_NS // setups[0].step_ns) == {}
    batch.close()
    assert not compiled or batch._runs_compiled.all()
    for index, setup in enumerate(setups):
        alone = Episode(setup, compiled=False)
        alone.begin(index, EpisodeOptions(noise=index != 2))
        for each in speeds(6, 4):
            alone.drive(*each[index, 0])
            alone.step(setup.steps_per_period)
        assert alone.boards.tolist() == batch.registers[index].tolist()
        assert batch.poses[index, 0] == pytest.approx(alone.pose, abs=1e-12)


@pytest.mark.parametrize("compiled", KINDS)
def test_a_speed_that_is_no_number_is_the_failure_of_one_episode(compiled: bool) -> None:
    setup = EpisodeSetup(Playpen.load("obstacles"), period_ns=PERIOD_NS, planar=True)
    batch = EpisodeBatch([Episode(setup, compiled=compiled) for _ in range(3)], 1)
    for index in range(3):
        batch.begin(index, index)
    batch.speeds[1] = np.nan
    [(row, failure)] = batch.step(np.arange(3), setup.steps_per_period).items()
    assert row == 1
    assert "episode of seed 1 failed" in str(failure)
    assert "expected finite numbers" in str(failure)
    assert [episode.time_ns for episode in batch.episodes] == [PERIOD_NS, 0, PERIOD_NS]
    batch.speeds[:] = 5
    assert batch.step(np.arange(3), setup.steps_per_period) == {}
    assert [episode.time_ns for episode in batch.episodes] == [2 * PERIOD_NS, PERIOD_NS, 2 * PERIOD_NS]
