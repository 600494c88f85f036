"""Copies by `copy.deepcopy` and `pickle`: constructed from the arguments, or refused with advice."""

import copy
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from khep_twin.board.fault_injection import parse_fault
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.world import World

WAYS = [
    pytest.param(copy.deepcopy, id="deepcopy"),
    pytest.param(lambda original: pickle.loads(pickle.dumps(original)), id="pickle"),
]
OPTIONS: dict[str, Any] = {"planar": True, "compiled": False, "seconds": 0.5}
SPEEDS = np.full(2, 0.5, np.float32)

Way = Callable[[Any], Any]


@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_a_gymnasium_environment_goes_on_with_its_episodes(way: Way) -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    environment = gymnasium.make("khep_twin/ObstacleAvoidance-v0", vary=True, **OPTIONS)
    environment.reset(seed=3)
    environment.step(SPEEDS)
    other = way(environment)
    assert other.spec == environment.spec
    with pytest.raises(ValueError, match=r"none has started; expected reset\(\) first"):
        other.step(SPEEDS)
    assert (other.reset()[0] == environment.reset()[0]).all()
    assert (other.step(SPEEDS)[0] == environment.step(SPEEDS)[0]).all()


@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_many_goes_on_with_their_episodes(way: Way) -> None:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    vectorized = gymnasium.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=2, threads=2, **OPTIONS)
    vectorized.reset(seed=3)
    other = way(vectorized)
    assert (other.reset()[0] == vectorized.reset()[0]).all()
    for environment in (vectorized, other):
        environment.close()


@pytest.mark.parametrize("way", WAYS)
def test_a_copy_of_robots_together_goes_on_with_their_episodes(way: Way) -> None:
    pettingzoo = pytest.importorskip("khep_twin.envs.pettingzoo")
    environment = pettingzoo.ParallelEnvironment("ObstacleAvoidance", 2, compiled=False)
    environment.reset(seed=3)
    other = way(environment)
    assert (other.reset()[0]["khepera1"] == environment.reset()[0]["khepera1"]).all()


@pytest.mark.parametrize("way", WAYS)
def test_a_copy_for_dm_control_has_the_same_episodes_from_the_first_on(way: Way) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # glfw, where there is no screen
        from khep_twin.envs.dm_env import load
    environment = load("ObstacleAvoidance", seed=3, compiled=False)
    first = environment.reset().observation["proximity"]
    assert (way(environment).reset().observation["proximity"] == first).all()
    with pytest.raises(TypeError, match=r"^Physics: cannot be copied .* with the same seed, whose"):
        way(environment.physics)


@pytest.mark.parametrize("way", WAYS)
def test_a_prepared_playpen_or_task_is_made_anew(way: Way) -> None:
    setup = way(EpisodeSetup("obstacles", period_ns=40_000_000, faults=map(parse_fault, ["dead:1"])))
    assert (setup.playpen.name, setup.period_ns, setup.faults) == (
        *("obstacles", 40_000_000),
        (parse_fault("dead:1"),),
    )
    assert way(EpisodeSetup("obstacles", planar=True)).planar_scene is not None
    assert way(TaskSetup("Homing", seconds=5.0)).n_steps == 100


@pytest.mark.parametrize("way", WAYS)
def test_what_is_not_copied_says_what_to_do_instead(way: Way) -> None:
    setup = EpisodeSetup("obstacles")
    with pytest.raises(TypeError, match=r"^World: cannot be copied .* restore\(world\.snapshot\(\)\) in it$"):
        way(World("obstacles"))
    with pytest.raises(TypeError, match=r"^Episode: cannot be copied .* started with the same seed$"):
        way(Episode(setup, compiled=False))
    with pytest.raises(TypeError, match=r"^TaskEpisode: cannot be copied"):
        way(TaskEpisode(TaskSetup("Homing", **OPTIONS)))
