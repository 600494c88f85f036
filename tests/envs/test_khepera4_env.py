"""Tasks of the Khepera IV as Gymnasium environments."""

import pickle

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import khep_twin  # noqa: E402
from khep_twin.errors import KhepTwinError, PlaypenError  # noqa: E402
from khep_twin.robots.khepera4.environments import TASKS, KheperaIVEnvironment  # noqa: E402
from khep_twin.robots.khepera4.model import KHEPERA_4  # noqa: E402


def test_the_registered_tasks_are_those_there_are() -> None:
    assert set(KHEPERA_4.environments) == set(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_an_environment_passes_gymnasiums_own_check(task: str) -> None:
    assert khep_twin.__version__  # which registers it
    check_env(gymnasium.make(f"khep_twin/{task}-v0", seconds=1).unwrapped, skip_render_check=True)


def test_a_seed_repeats_an_episode_in_a_copy_too() -> None:
    first = KheperaIVEnvironment(seconds=0.5, vary=True)
    _, info = first.reset(seed=3)
    steps = [first.step(np.array([0.6, -0.2]))[:2] for _ in range(10)]
    second = pickle.loads(pickle.dumps(first))
    second.reset(options={"seed": info["seed"]})
    for observation, reward in steps:
        again = second.step(np.array([0.6, -0.2]))
        assert (again[0] == observation).all()
        assert again[1] == reward
    with pytest.raises(ValueError, match="the episode is over"):
        second.step(np.zeros(2))


def test_driving_ahead_is_rewarded_and_standing_at_a_wall_is_not() -> None:
    environment = KheperaIVEnvironment(noise=False, start=(1000, 300, 90))
    environment.reset()
    rewards = [environment.step(np.array([0.5, 0.5]))[1] for _ in range(40)]
    assert rewards[-1] == pytest.approx(0.5, abs=0.05)
    environment.reset(options={"start": (1000, 1925, 90)})
    rewards = [environment.step(np.array([0.5, 0.5]))[1] for _ in range(40)]
    assert max(rewards[20:]) < 0.02


def test_a_controller_that_steers_by_the_ground_sensors_follows_the_line() -> None:
    environment = KheperaIVEnvironment("KheperaIVLineFollowing", seconds=20)
    observation, _ = environment.reset(seed=1)
    total, is_truncated = 0.0, False
    while not is_truncated:
        left, right = observation[1], observation[2]
        turn = 0.12 * float(np.sign(right - left))
        observation, reward, ended, is_truncated, _ = environment.step(np.array([0.3 - turn, 0.3 + turn]))
        total += reward
        assert not ended
    assert total / 400 > 0.15


def test_wrong_arguments_are_one_line() -> None:
    with pytest.raises(KhepTwinError, match="task 'Line': unknown"):
        KheperaIVEnvironment("Line")
    with pytest.raises(PlaypenError, match="obstacles: robots; expected one Khepera IV"):
        KheperaIVEnvironment(playpen="obstacles")
    environment = KheperaIVEnvironment()
    environment.reset(seed=1)
    with pytest.raises(ValueError, match="expected two speeds"):
        environment.step(np.array([np.nan, 0]))
