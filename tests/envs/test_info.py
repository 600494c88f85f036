"""Infos: parts of the reward, contacts, metrics and returns, of one environment and of many."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS

from khep_twin.envs import tasks
from khep_twin.envs.tasks import TASKS, Task
from khep_twin.episodes.controllers import ConstantSpeed
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup

pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")

from gymnasium.wrappers import RecordEpisodeStatistics
from gymnasium.wrappers.vector import RecordEpisodeStatistics as RecordMany

from khep_twin.envs.gymnasium import KheperaEnvironment
from khep_twin.envs.gymnasium_vector import KheperaVectorEnvironment

SHORT: dict[str, Any] = {"planar": True, "compiled": False, "seconds": 0.5}
FAST = np.array([1.0, 0.8], np.float32)


def driven(environment: Any, action: Any = FAST, seed: int = 1) -> list[tuple[float, dict[str, Any]]]:
    """Return rewards and infos of an episode."""
    environment.reset(seed=seed)
    steps, over = [], False
    while not over:
        _, reward, ended, late, info = environment.step(action)
        steps.append((reward, info))
        over = ended or late
    return steps


WITH_PARTS = {name: task for name, task in TASKS.items() if task.reward in tasks._PARTS}


@pytest.mark.parametrize("task", WITH_PARTS.values(), ids=list(WITH_PARTS))
def test_the_parts_of_a_reward_have_the_reward_as_their_product(task: Task) -> None:
    for reward, info in driven(KheperaEnvironment(task, details=True, **SHORT)):
        assert np.prod(list(info["reward_parts"].values())) == pytest.approx(reward, abs=1e-12)
        assert all(0 <= part <= 1 for part in info["reward_parts"].values())


def test_a_reward_without_parts_has_none_and_nothing_is_told_unasked() -> None:
    task = dataclasses.replace(TASKS["Homing"], reward=lambda state: 0.5)
    episode_info = driven(KheperaEnvironment(task, details=True, **SHORT))[-1][1]
    assert "reward_parts" not in episode_info
    assert episode_info["episode"] == {"r": 5.0, "l": 10, "t": 0.5}
    usual = [info for _, info in driven(KheperaEnvironment("Homing", **SHORT))]
    assert all(list(info) == ["x", "y", "heading", "time", "seed"] for info in usual)


@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("planar", [True, False])
def test_a_robot_that_drives_against_a_wall_is_in_contact_with_it(planar: bool, compiled: bool) -> None:
    options = {
        **SHORT,
        "planar": planar,
        "compiled": compiled,
        "seconds": 1.0,
        "start": (60, 500, 180),
        "details": True,
    }
    environment = KheperaEnvironment("ObstacleAvoidance", **options)
    touches = [info["contact"] for _, info in driven(environment, [1, 1])]
    assert touches[0] is False
    assert touches[-5:] == [True] * 5


def test_metrics_at_the_end_are_those_of_an_episode_with_a_controller() -> None:
    first, *_, last = driven(
        KheperaEnvironment("LoopingMaze", start=(60, 60, 0), details=True, **SHORT), [0.5, 0.5]
    )
    metrics = last[1]["metrics"]
    setup = EpisodeSetup("looping-maze", period_ns=50_000_000, planar=True)
    alone = Episode(setup, ConstantSpeed(10, 10), compiled=False)
    alone.begin(first[1]["seed"], EpisodeOptions(start=(60, 60, 0)))
    alone.run(0.5)
    assert "homing" not in metrics
    assert metrics == {name: alone.metrics()[name] for name in metrics}
    assert driven(KheperaEnvironment("Homing", details=True, **SHORT))[-1][1]["metrics"]["homing"] > 0


def test_an_episode_is_told_as_gymnasiums_wrapper_tells_it() -> None:
    recorded = driven(RecordEpisodeStatistics(KheperaEnvironment("Homing", **SHORT)))[-1][1]["episode"]
    ours = driven(KheperaEnvironment("Homing", details=True, **SHORT))[-1][1]["episode"]
    assert ours.keys() == recorded.keys()
    assert (ours["r"], ours["l"]) == (recorded["r"], recorded["l"])
    runs = driven(
        RecordEpisodeStatistics(KheperaEnvironment("Homing", details=True, **SHORT), stats_key="theirs")
    )
    assert runs[-1][1]["theirs"]["r"] == runs[-1][1]["episode"]["r"]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_many_are_told_as_gymnasiums_wrapper_tells_them(mode: str) -> None:
    # Charges that run out at different times.
    task = dataclasses.replace(TASKS["Homing"], charge_s=0.3, reach_mm=360.0)
    plain = RecordMany(KheperaVectorEnvironment(4, task, autoreset_mode=mode, **SHORT))
    ours = KheperaVectorEnvironment(4, task, autoreset_mode=mode, details=True, **SHORT)
    for environments in (plain, ours):
        environments.reset(seed=2)
    n_endings = 0
    for _ in range(25):
        *_, ended, late, theirs = plain.step(np.tile(FAST, (4, 1)))
        infos = ours.step(np.tile(FAST, (4, 1)))[4]
        over = ended | late
        if over.any():
            final_infos = infos["final_info"] if mode == "SameStep" else infos
            assert (final_infos["_episode"] == theirs["_episode"]).all()
            for name in "rl":
                assert (final_infos["episode"][name] == theirs["episode"][name]).all()
            n_endings += 1
            if mode == "Disabled":
                for environments in (plain, ours):
                    environments.reset(options={"reset_mask": over.copy()})
        else:
            assert "episode" not in infos
    assert n_endings > 2
    plain.close()
    ours.close()


@pytest.mark.parametrize("compiled", KINDS)
def test_many_tell_the_same_details_as_one_by_one(compiled: bool) -> None:
    from test_environment import actions, gyms, same

    options = {
        "planar": True,
        "details": True,
        "compiled": compiled,
        "randomize": {"noise": 0.5, "delay": (0, 0.04)},
    }
    for mode in ("NextStep", "SameStep"):
        task = dataclasses.replace(TASKS["Homing"], charge_s=0.3, reach_mm=360.0)
        vectorized = gyms(3, task=task, autoreset_mode=mode, **options)
        synchronous = gyms(
            3, task=task, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **options
        )
        assert same(vectorized.reset(seed=2), synchronous.reset(seed=2))
        for action in actions(15, 3):
            assert same(vectorized.step(action), synchronous.step(action))
        vectorized.close()
        synchronous.close()


def test_each_robot_of_several_is_told_its_own() -> None:
    pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")
    from khep_twin.envs.pettingzoo import ParallelEnvironment

    starts = [(100, 500, 0), (700, 500, 0)]
    together = ParallelEnvironment(
        "ObstacleAvoidance", 2, start=starts, details=True, seconds=0.2, compiled=False
    )
    _, infos = together.reset(seed=1)
    assert [round(info["x"] * 1e3) for info in infos.values()] == [100, 700]
    earned = {agent: 0.0 for agent in together.agents}
    while together.agents:
        _, rewards, _, _, infos = together.step({"khepera0": FAST, "khepera1": -FAST})
        for agent, reward in rewards.items():
            earned[agent] += reward
    assert {agent: info["episode"]["r"] for agent, info in infos.items()} == earned
    assert infos["khepera0"]["metrics"]["forward_m"] > 0 > infos["khepera1"]["metrics"]["forward_m"]
