"""Environments: dm_env, Gymnasium and PettingZoo, by the checks of their libraries and against each other."""

import builtins
import dataclasses
import importlib
import importlib.util
import math
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS, with_numba

from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.envs.renderer import MapWarning, Renderer
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.envs.tasks import TASKS, State, batched
from khep_twin.episodes import version_check
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg
from khep_twin.errors import DivergedError, KhepTwinError, MissingExtraError, PlaypenError
from khep_twin.playpen import Playpen, Spot

SHORT = {"seconds": 0.5, "compiled": False}


def actions(count: int, *shape: int) -> np.ndarray:
    """Return random actions (count, *shape, 2)."""
    return np.random.default_rng(0).uniform(-1, 1, (count, *shape, 2)).astype(np.float32)


# dm_control ---------------------------------------------------------------------------------------------


def dm(task: str, **options: Any) -> Any:
    # glfw, which dm_control tries first, warns where there is no screen.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from khep_twin.envs.dm_env import load

    return load(task, **{**SHORT, **options})


@pytest.mark.parametrize("task", TASKS)
def test_dm_env_observations_and_rewards_keep_to_their_specs(task: str) -> None:
    environment = dm(task, seed=1)
    specs = environment.observation_spec()
    step = environment.reset()
    assert step.first()
    for action in actions(10):
        assert list(step.observation) == list(specs)
        for name, spec in specs.items():
            spec.validate(step.observation[name])
        environment.action_spec().validate(action.astype(float))
        step = environment.step(action)
        assert 0 <= step.reward <= 1
    assert step.last()
    assert step.discount == 1


def test_dm_env_is_the_same_again_by_its_seed_and_starts_each_episode_anew() -> None:
    def way(seed: int) -> list[bytes]:
        environment = dm("ObstacleAvoidance", seed=seed)
        return [environment.step(action).observation["proximity"].tobytes() for action in actions(33)]

    assert way(1) == way(1)
    assert way(1) != way(2)
    assert way(1)[:11] != way(1)[11:22]


def test_dm_env_ends_with_no_discount_when_the_charge_has_run_out() -> None:
    environment = dm("Homing", seconds=30.0)
    environment.reset()
    while not (step := environment.step([0.0, 0.0])).last():
        pass
    assert step.discount == 0
    assert environment.physics.time() == pytest.approx(20.0)


def test_the_physics_names_what_it_has() -> None:
    environment = dm("LightSeeking", seed=4)
    environment.reset()
    environment.step([0.25, 0.45])
    physics, episode = environment.physics, environment.physics.episode
    environment.step([0.25, 0.45])
    assert physics.setpoints().tolist() == [5, 9]
    assert physics.proximity().shape == physics.ambient().shape == (8,)
    assert tuple(physics.pose()) == episode.poses[0]
    # MuJoCo's bodies are where they were at the start of the last step of 2.5 ms.
    assert physics.named.data.xpos["khepera0/base"][:2] == pytest.approx(physics.pose()[:2], abs=3e-4)
    with pytest.raises(TypeError, match="same seed"):
        physics.copy()


def test_the_physics_of_a_robot_of_any_model_has_its_registers() -> None:
    environment = dm("ObstacleAvoidance", playpen="arena4", seed=1, noise=False)
    environment.reset()
    environment.step([0.25, 0.5])
    physics = environment.physics
    assert physics.setpoints().tolist() == [150, 300]
    assert physics.proximity() == pytest.approx(np.full(8, 100), abs=50)  # with nothing near
    assert physics.ambient() == pytest.approx(np.full(8, 980), abs=10)


def test_the_physics_follows_a_world_that_is_made_anew_each_time() -> None:
    scene = Playpen.load("two-lamps")
    lighting = scene.lighting.model_copy(update={"mode": "sequenced"})
    environment = dm("LightSeeking", playpen=scene.model_copy(update={"lighting": lighting}))
    for _ in range(2):
        environment.reset()
        environment.step([0.5, 0.5])
        physics = environment.physics
        assert physics.named.data.xpos["khepera0/base"][:2] == pytest.approx(physics.pose()[:2], abs=3e-4)


def test_another_pair_of_versions_is_refused_at_import(monkeypatch: pytest.MonkeyPatch) -> None:
    dm("Homing")  # so that only our own module is imported anew
    monkeypatch.delitem(sys.modules, "khep_twin.envs.dm_env")
    monkeypatch.setattr(version_check.metadata, "version", {"mujoco": "4.0.0", "dm-control": "1.0.50"}.get)
    with pytest.raises(KhepTwinError, match=r"mujoco 4\.0\.0 and dm-control 1\.0\.50 are not known to"):
        importlib.import_module("khep_twin.envs.dm_env")


def test_without_dm_control_the_import_is_one_line_that_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed = version_check.metadata.version

    def version(name: str) -> str:
        if name == "dm-control":
            raise version_check.metadata.PackageNotFoundError(name)
        return installed(name)

    dm("Homing")  # so that only our own module is imported anew
    monkeypatch.delitem(sys.modules, "khep_twin.envs.dm_env")
    monkeypatch.setattr(version_check.metadata, "version", version)
    with pytest.raises(KhepTwinError, match=r"^dm-control is not installed; .* --no-deps .*==1\.0\.50$"):
        importlib.import_module("khep_twin.envs.dm_env")


def test_dm_env_takes_its_options_as_the_suite_does_too() -> None:
    suite = dm("LightSeeking", task_kwargs={"random": 3, "time_limit": 1.0, "vary": True})
    ours = dm("LightSeeking", seed=3, seconds=1.0, vary=True)
    assert (suite.reset().observation["light"] == ours.reset().observation["light"]).all()
    flat = dm("LightSeeking", seed=3, vary=True, environment_kwargs={"flat_observation": True})
    (spec,) = flat.observation_spec().values()
    (numbers,) = flat.reset().observation.values()
    spec.validate(numbers)
    assert (numbers[8:16] == dm("LightSeeking", seed=3, vary=True).reset().observation["light"]).all()


def test_dm_env_takes_starts_lamps_and_a_randomization() -> None:
    from khep_twin import Lamp

    options = {"start": (300, 150, -90), "lamps": [Lamp(x_mm=500, y_mm=500, power_w=5)]}
    environment = dm("LightSeeking", seed=1, **options)
    observation = environment.reset().observation
    assert environment.physics.pose() == pytest.approx((0.3, 0.15, -math.pi / 2))
    same_seed = {"seed": environment.task.seed}
    assert (observation["light"] == gym("LightSeeking", **options).reset(options=same_seed)[0][8:16]).all()
    moved = dm("WallOrCylinder", seed=1, randomize={"blocks_mm": 60, "playpens": 3})
    places = set()
    for _ in range(6):
        moved.reset()
        moved.step([0.5, 0.5])
        physics = moved.physics
        assert physics.named.data.xpos["khepera0/base"][:2] == pytest.approx(physics.pose()[:2], abs=3e-4)
        places.add(physics.named.data.geom_xpos["cylinder0"].tobytes())
    assert len(places) == 3
    with pytest.raises(KhepTwinError, match=r"^details = True: dm_env has no infos; expected False"):
        dm("LightSeeking", details=True)


def test_what_of_the_suite_has_no_effect_is_refused() -> None:
    with pytest.raises(KhepTwinError, match=r"^visualize_reward = True; expected False"):
        dm("Homing", visualize_reward=True)
    with pytest.raises(KhepTwinError, match=r"^environment_kwargs: 'time_limit': unknown; .* seconds"):
        dm("Homing", environment_kwargs={"time_limit": 5})
    with pytest.raises(ValueError, match=r"seed = RandomState.*; expected an integer from 0"):
        dm("Homing", task_kwargs={"random": np.random.RandomState(1)})


# Gymnasium ----------------------------------------------------------------------------------------------


def gym(task: str, **options: Any) -> Any:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    import khep_twin.envs.gymnasium  # noqa: F401

    return gymnasium.make(f"khep_twin/{task}-v0", **{**SHORT, **options})


def gyms(count: int, **options: Any) -> Any:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    import khep_twin.envs.gymnasium  # noqa: F401

    return gymnasium.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=count, **{**SHORT, **options})


@pytest.mark.share(2)
# A warning of Gymnasium, from the checker or from what `make` puts around an environment, is an error here.
@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_wrong_and_warns_of_nothing(task: str) -> None:
    environment = gym(task, view="map", render_mode="rgb_array")
    from gymnasium.utils.env_checker import check_env

    check_env(environment.unwrapped)
    environment.reset(seed=1)
    while not any(environment.step(environment.action_space.sample())[2:4]):
        pass
    environment.render()
    environment.close()


@pytest.mark.parametrize("task", TASKS)
def test_actions_and_observations_lie_between_minus_1_and_1(task: str) -> None:
    environment = gym(task)
    for space, size in (
        (environment.action_space, 2),
        (environment.observation_space, len(environment.unwrapped.labels)),
    ):
        assert space.shape == (size,)
        assert space.dtype == np.float32
        assert (space.low == -1).all()
        assert (space.high == 1).all()


def test_without_normalization_actions_and_observations_are_in_the_robots_units() -> None:
    raw, usual = gym("LightSeeking", normalize=False), gym("LightSeeking")
    assert (raw.action_space.high == 20).all()
    assert raw.observation_space.high.tolist() == [1023] * 16 + [20] * 2
    assert raw.observation_space.low.tolist() == [0] * 16 + [-20] * 2
    raw.reset(seed=1)
    usual.reset(seed=1)
    for action in actions(10):
        observation, *rest = raw.step(action * 20)
        normalized, *usual_rest = usual.step(action)
        assert rest == usual_rest
        registers = raw.unwrapped._episode.registers[0]
        assert observation[:16].tolist() == registers[PROXIMITY + AMBIENT].tolist()
        assert normalized[:8] == pytest.approx(observation[:8] / 1023 * 2 - 1)
        assert normalized[16:] == pytest.approx(observation[16:] / 20)


def test_gymnasium_is_the_same_again_by_its_seed() -> None:
    def way(seed: int) -> list[bytes]:
        environment, observations = gym("LoopingMaze", noise=True, vary=True), []
        for episode in range(2):
            observations.append(environment.reset(seed=seed if not episode else None)[0].tobytes())
            observations += [environment.step(action)[0].tobytes() for action in actions(10)]
        return observations

    assert way(1) == way(1)
    assert way(1) != way(2)
    assert way(1)[:11] != way(1)[11:]


def test_an_episode_of_gymnasium_is_repeated_by_the_seed_in_its_info() -> None:
    environment = gym("LoopingMaze")
    environment.reset(seed=1)
    observation, info = environment.reset()
    again, reset_info = gym("LoopingMaze").reset(options={"seed": info["seed"]})
    assert (observation == again).all()
    assert info == reset_info


def same(ours: Any, theirs: Any) -> bool:
    """Return whether two results are the same to the last bit, also in dicts and in arrays of objects."""
    if isinstance(theirs, dict):
        return ours.keys() == theirs.keys() and all(same(ours[key], theirs[key]) for key in theirs)
    if isinstance(theirs, tuple):
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    if isinstance(theirs, np.ndarray) and theirs.dtype == object:
        return len(ours) == len(theirs) and all(map(same, ours, theirs))
    return np.array_equal(ours, theirs) and getattr(ours, "dtype", None) == getattr(theirs, "dtype", None)


def of(infos: dict[str, Any], index: int) -> dict[str, Any]:
    """Return the info of one of many environments."""
    return {
        name: of(value, index) if isinstance(value, dict) else value[index]
        for name, value in infos.items()
        if name[0] != "_" and infos[f"_{name}"][index]
    }


def test_each_of_many_is_the_same_as_a_single_one_with_its_seed() -> None:
    vector_environment, singles = gyms(3, threads=2), [gym("ObstacleAvoidance") for _ in range(3)]
    observations = [vector_environment.reset(seed=7)[0]]
    alone = [[environment.reset(seed=7 + index)[0]] for index, environment in enumerate(singles)]
    for action in actions(15, 3):
        results = vector_environment.step(action)
        for index, environment in enumerate(singles):
            if len(alone[index]) == 11:  # over after ten steps of 50 ms
                result = (*environment.reset()[:1], 0.0, False, False)
            else:
                result = environment.step(action[index])[:4]
            assert [part[index] for part in results[1:4]] == list(result[1:4])
            alone[index].append(result[0])
        observations.append(results[0])
    assert same(np.stack(observations, axis=1), np.array(alone))
    vector_environment.close()


@with_numba
def test_many_compiled_are_the_same_as_in_plain_python() -> None:
    compiled, plain = gyms(3, threads=2, compiled=True), gyms(3, threads=2)
    assert same(compiled.reset(seed=5), plain.reset(seed=5))
    for action in actions(15, 3):
        assert same(compiled.step(action), plain.step(action))
    compiled.close()
    plain.close()


@pytest.mark.share(2)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_what_follows_an_episode_of_many_is_as_gymnasium_has_it(mode: str) -> None:
    # A charge that runs out terminates an episode; the time limit truncates another one.
    task = dataclasses.replace(TASKS["Homing"], charge_s=0.3, reach_mm=360.0)
    vectorized = gyms(4, task=task, autoreset_mode=mode)
    synchronous = gyms(4, task=task, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode})
    assert vectorized.metadata == synchronous.metadata
    assert same(vectorized.reset(seed=2), synchronous.reset(seed=2))
    endings = set()
    for action in actions(25, 4):
        ours, theirs = vectorized.step(action), synchronous.step(action)
        assert same(ours, theirs)
        endings |= {(bool(ended), bool(late)) for ended, late in zip(ours[2], ours[3], strict=True)}
        if mode == "SameStep" and (ours[2] | ours[3]).any():
            over = ours[2] | ours[3]
            assert (ours[4]["_final_obs"] == over).all()
            assert (ours[4]["final_info"]["time"][over] > 0).all()
            assert (ours[4]["time"][over] == 0).all()
    assert endings >= {(False, False), (True, False), (False, True)}
    vectorized.close()
    synchronous.close()


def test_without_autoreset_a_mask_starts_episodes_that_are_over() -> None:
    task = dataclasses.replace(TASKS["Homing"], charge_s=0.3, reach_mm=360.0)
    vectorized = gyms(4, task=task, autoreset_mode="Disabled")
    synchronous = gyms(4, task=task, vectorization_mode="sync", vector_kwargs={"autoreset_mode": "Disabled"})
    assert vectorized.metadata == synchronous.metadata
    assert same(vectorized.reset(seed=2), synchronous.reset(seed=2))
    masks = []
    for action in actions(25, 4):
        ours, theirs = vectorized.step(action), synchronous.step(action)
        assert same(ours, theirs)
        over = ours[2] | ours[3]
        if over.any():
            masks.append(over.sum())
            with pytest.raises(ValueError, match=r"environments \[.*\] are over; expected reset\("):
                vectorized.step(action)
            options = {"reset_mask": over}
            assert same(vectorized.reset(options=options), synchronous.reset(options={**options}))
            assert list(options) == ["reset_mask"]
    assert 0 < min(masks) < 4
    for mask in (np.zeros(4, np.bool_), np.ones(3, np.bool_), np.ones(4)):
        with pytest.raises(ValueError, match="expected an array of 4 bool, at least one of them true"):
            vectorized.reset(options={"reset_mask": mask})
    vectorized.close()
    synchronous.close()


def test_an_unknown_autoreset_mode_is_refused_with_the_known_ones() -> None:
    with pytest.raises(KhepTwinError, match="did you mean 'NextStep'"):
        gyms(2, autoreset_mode="NextStp")


def test_an_error_in_one_of_many_is_raised_and_leaves_them_usable() -> None:
    vectorized = gyms(3, threads=3)
    first = vectorized.reset(seed=1)
    with pytest.raises(DivergedError, match="expected finite numbers"):
        vectorized.step(np.array([[0, 0], [math.nan, 0], [0, 0]], np.float32))
    # The others were stepped.
    assert vectorized.unwrapped._batch.periods.tolist() == [1, 0, 1]
    assert same(vectorized.reset(seed=1), first)
    vectorized.close()


def test_gymnasiums_ways_to_make_many_are_known() -> None:
    named = gyms(2, vectorization_mode="vector_entry_point")
    assert type(named.unwrapped) is type(gyms(2).unwrapped)
    assert named.spec.id == "khep_twin/ObstacleAvoidance-v0"
    named.close()


@pytest.mark.parametrize("threads", [1, 3])
def test_many_in_threads_are_the_same_as_one_after_another(threads: int) -> None:
    vectorized, synchronous = gyms(3, threads=threads), gyms(3, vectorization_mode="sync")
    assert vectorized.metadata["autoreset_mode"] == synchronous.metadata["autoreset_mode"]
    assert vectorized.observation_space == synchronous.observation_space
    assert vectorized.action_space == synchronous.action_space
    pairs = [(vectorized.reset(seed=4), synchronous.reset(seed=4))]
    pairs += [
        (vectorized.step(action), synchronous.step(action)) for action in actions(25, 3)
    ]  # more than two episodes
    for ours, theirs in pairs:
        assert same(ours, theirs)
    vectorized.close()
    synchronous.close()


def test_lamps_that_blink_shine_the_same_in_any_number_of_threads() -> None:
    place = Playpen.load("light-seeking")
    lamps = tuple(lamp.model_copy(update={"blink_period_s": 0.3, "fade_s": 0.07}) for lamp in place.lamps)
    blinking = place.model_copy(update={"lamps": lamps})

    def observe(threads: int) -> list[Any]:
        environments = gyms(4, task="LightSeeking", playpen=blinking, threads=threads, seconds=2.0)
        environments.reset(seed=1)
        observations = [environments.step(action)[0] for action in actions(40, 4)]
        environments.close()
        return observations

    alone, usual = observe(1), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads are switched all the time
    try:
        together = observe(4)
    finally:
        sys.setswitchinterval(usual)
    assert all((one == other).all() for one, other in zip(alone, together, strict=True))


@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("task", ["ObstacleAvoidance", "Homing"])
def test_each_of_many_in_the_plane_is_the_same_as_a_single_plain_one(task: str, compiled: bool) -> None:
    vectorized = gyms(3, task=TASKS[task], planar=True, compiled=compiled, vary=True, threads=2)
    singles = [gym(task, planar=True, vary=True) for _ in range(3)]
    first, infos = vectorized.reset(seed=7)
    for index, environment in enumerate(singles):
        observation, info = environment.reset(seed=7 + index)
        assert (observation == first[index]).all()
        assert info == {name: infos[name][index] for name in info}
    for action in actions(10, 3):
        *results, infos = vectorized.step(action)
        for index, environment in enumerate(singles):
            *alone, info = environment.step(action[index])
            assert [part[index] for part in results[1:]] == alone[1:]
            assert (results[0][index] == alone[0]).all()
            assert info == of(infos, index)
    vectorized.close()


def test_in_the_plane_the_observations_are_like_those_of_mujoco() -> None:
    plane, mujoco = gym("LoopingMaze", planar=True, noise=False), gym("LoopingMaze", noise=False)
    for environment in (plane, mujoco):
        environment.reset(seed=2)
    for _ in range(10):
        plane_observation, mujoco_observation = plane.step([0.5, 0.4])[0], mujoco.step([0.5, 0.4])[0]
    assert plane_observation == pytest.approx(mujoco_observation, abs=0.05)


def test_in_the_plane_a_picture_is_a_map() -> None:
    environment = gym("ObstacleAvoidance", planar=True, render_mode="rgb_array")
    environment.reset(seed=1)
    assert environment.render().shape[2] == 3
    assert environment.unwrapped._renderer.view == "map"
    vectorized = gyms(2, planar=True, render_mode="rgb_array")
    vectorized.reset(seed=1)
    assert (vectorized.render()[0] == environment.render()).all()
    vectorized.close()


def test_what_a_plane_has_not_is_refused_in_one_line() -> None:
    scene = Playpen.load("obstacles")
    movable = tuple(block.model_copy(update={"movable": True, "width_mm": 9.0}) for block in scene.blocks)
    with pytest.raises(PlaypenError, match=r"is movable, 9 mm wide .* in the plane, where nothing tips over"):
        gyms(2, planar=True, playpen=scene.model_copy(update={"blocks": movable}))
    with pytest.raises(KhepTwinError, match=r"^planar = True: dm_env needs MuJoCo's physics; expected False"):
        dm("ObstacleAvoidance", planar=True)


@pytest.mark.parametrize("planar", [False, True])
def test_a_reward_of_one_state_is_the_same_for_many_as_for_one(planar: bool) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    from khep_twin.envs.gymnasium import KheperaEnvironment

    def straight(state: State) -> float:
        return 1.0 if state.left > 0 and max(state.registers[index] for index in PROXIMITY) < 500 else 0.25

    @batched
    def straight_of_all(state: State) -> Any:
        return np.where((state.left > 0) & (state.nearest < 500 / 1023), 1.0, 0.25)

    rewards = []
    for reward in (straight, straight_of_all):
        task = dataclasses.replace(TASKS["ObstacleAvoidance"], reward=reward)
        vectorized = gyms(3, task=task, planar=planar)
        one = KheperaEnvironment(task, planar=planar, **SHORT)
        vectorized.reset(seed=3)
        one.reset(seed=3)
        rewards.append([vectorized.step(action)[1].tolist() for action in actions(10, 3)])
        assert [one.step(action[0])[1] for action in actions(10, 3)] == [row[0] for row in rewards[-1]]
        vectorized.close()
    assert rewards[0] == rewards[1]
    assert {0.25, 1.0} == {reward for row in rewards[0] for reward in row}


def test_gymnasium_and_dm_env_are_the_same_episode() -> None:
    environment = dm("Homing", seed=3)
    first = environment.reset()
    observation, _ = gym("Homing").reset(options={"seed": environment.task.seed})
    assert (np.concatenate(list(first.observation.values())) == observation).all()


@pytest.mark.parametrize("charge_s", [0.0, 0.1])
def test_a_step_before_a_reset_or_after_the_end_asks_for_a_reset(charge_s: float) -> None:
    task = dataclasses.replace(TASKS["Homing"], charge_s=charge_s)
    environment = type(gym("Homing").unwrapped)(task, planar=True, **SHORT)
    vectorized = gyms(2, planar=True)
    together = zoo("ObstacleAvoidance", 1, planar=True)
    for stepped, action in (
        (environment, [0, 0]),
        (vectorized, [[0, 0], [0, 0]]),
        (together, {"khepera0": [0, 0]}),
    ):
        with pytest.raises(ValueError, match=r"started.*; expected reset\(\) first"):
            stepped.step(np.array(action) if isinstance(action, list) else action)
    environment.reset(seed=1)
    while not any(environment.step(np.zeros(2))[2:4]):
        pass
    with pytest.raises(ValueError, match=r"^the episode is over, .* expected reset\(\) first"):
        environment.step(np.zeros(2))
    vectorized.close()
    for call in (vectorized.reset, lambda: vectorized.step(np.zeros((2, 2)))):
        with pytest.raises(ValueError, match=r"^the environments are closed; expected new ones$"):
            call()


# PettingZoo ---------------------------------------------------------------------------------------------


def zoo(task: str, robots: int, **options: Any) -> Any:
    pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")
    from khep_twin.envs.pettingzoo import ParallelEnvironment

    return ParallelEnvironment(task, robots, **{"seconds": 0.5, **options})


@pytest.mark.parametrize(("task", "robots"), [("ObstacleAvoidance", 3), ("Homing", 2)])
def test_pettingzoo_finds_nothing_wrong(task: str, robots: int) -> None:
    environment = zoo(task, robots)
    from pettingzoo.test import parallel_api_test

    parallel_api_test(environment, num_cycles=25)


def test_robots_together_are_the_same_again_by_their_seed() -> None:
    def way(seed: int) -> list[bytes]:
        environment = zoo("ObstacleAvoidance", 3)
        observations = [environment.reset(seed=seed)[0]]
        for action in actions(10, 3):
            observations.append(environment.step(dict(zip(environment.agents, action, strict=True)))[0])
        assert not environment.agents
        return [row.tobytes() for rows in observations for row in rows.values()]

    assert way(1) == way(1)
    assert way(1) != way(2)


def test_robots_together_see_each_other() -> None:
    scene = Playpen.load("default")
    spots = tuple(
        Spot(name=f"at-{x_mm}", x_mm=x_mm, y_mm=250, heading_deg=heading)
        for x_mm, heading in ((300, 0), (357, 180))
    )
    robot = scene.robots[0].model_copy(update={"spots": tuple(spot.name for spot in spots)})
    scene = scene.model_copy(update={"spots": spots, "robots": (robot,)})
    alone, together = zoo("LoopingMaze", 1, playpen=scene), zoo("LoopingMaze", 2, playpen=scene)
    nearest = [environment.reset(seed=0)[0]["khepera0"][:8].max() for environment in (alone, together)]
    assert nearest[0] < -0.8
    assert nearest[1] > 0


def test_in_the_plane_there_is_one_robot() -> None:
    environment = zoo("ObstacleAvoidance", 1, planar=True)
    observation, _ = environment.reset(seed=1)
    assert (
        observation["khepera0"] == zoo("ObstacleAvoidance", 1, planar=True).reset(seed=1)[0]["khepera0"]
    ).all()
    assert environment.step({"khepera0": np.ones(2, np.float32)})[1].keys() == {"khepera0"}
    with pytest.raises(PlaypenError, match=r"obstacles: 2 robots; expected one in the plane"):
        zoo("ObstacleAvoidance", 2, planar=True)


def test_an_agent_without_an_action_is_named() -> None:
    environment = zoo("ObstacleAvoidance", 2)
    environment.reset(seed=1)
    with pytest.raises(KhepTwinError, match="no action for khepera1"):
        environment.step({"khepera0": np.zeros(2, np.float32)})


# Mistakes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seconds", [0.0, -1.0, math.nan, math.inf, 0.06])
def test_an_episode_lasts_whole_control_periods(seconds: float) -> None:
    with pytest.raises(
        ValueError, match=r"seconds = .*; expected one or more whole control periods of 50 ms"
    ):
        TaskSetup("ObstacleAvoidance", seconds=seconds)


@pytest.mark.parametrize("action", [[1.0], [1.0, 2.0, 3.0], 5.0, "ab", None])
def test_an_action_that_is_not_two_speeds_is_an_error_of_one_line(action: Any) -> None:
    for normalize, limits in ((True, "-1 to 1"), (False, "-20 to 20")):
        setup = TaskSetup("ObstacleAvoidance", normalize=normalize)
        with pytest.raises(
            ValueError, match=rf"action .*; expected two speeds, left and right, from {limits}"
        ):
            setup.speeds(action)


@pytest.mark.parametrize("count", [0, -1, 1.5, "2"])
def test_a_number_of_threads_or_robots_is_a_whole_one(count: Any) -> None:
    expected = r"; expected a whole number, 1 or more"
    for options in ({"threads": count}, {"num_envs": count}):
        with pytest.raises(ValueError, match=rf"^{count!r} (threads|environments){expected}"):
            pytest.importorskip("khep_twin.envs.gymnasium_vector").KheperaVectorEnvironment(**options)
    with pytest.raises(ValueError, match=f"^{count!r} robots{expected}"):
        TaskSetup("Homing", robots=count)
    with pytest.raises(ValueError, match=f"^{count!r} threads{expected}"):
        rollout("obstacles", Braitenberg(), [1], 0.02, threads=count)


def test_as_many_actions_as_environments_are_wanted() -> None:
    environments = gyms(3)
    environments.reset(seed=1)
    for count in (2, 4):
        with pytest.raises(ValueError, match=rf"actions of shape \({count}, 2\); expected \(3, 2\)"):
            environments.step(np.zeros((count, 2), np.float32))
    environments.close()


# Pictures and extras ------------------------------------------------------------------------------------


def test_a_map_shows_where_the_robot_is_and_looking_changes_nothing() -> None:
    episodes = [TaskEpisode(TaskSetup("LoopingMaze", **SHORT)) for _ in range(2)]
    renderer = Renderer("map")
    for episode in episodes:
        episode.begin(1)
    pictures = []
    for _ in range(5):
        pictures.append(renderer.picture(episodes[0].episode))
        looked, not_looked = (episode.step([(1, 0.75)])[0].observation for episode in episodes)
        assert (looked == not_looked).all()
    assert all(picture.dtype == np.uint8 and picture.shape == pictures[0].shape for picture in pictures)
    assert (pictures[0] != pictures[-1]).any()


def test_where_there_is_no_screen_the_checker_warns_of_nothing_and_pictures_are_maps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    environment = gym("ObstacleAvoidance", render_mode="rgb_array")
    from gymnasium.utils.env_checker import check_env

    check_env(environment.unwrapped)
    assert environment.unwrapped._renderer.view == "map"
    assert Renderer("scene").view == "scene"


def test_without_gl_auto_is_a_map_with_a_warning_and_a_scene_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without(*args: Any) -> None:
        raise RuntimeError("no library.")

    monkeypatch.setattr("mujoco.Renderer", without)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    episode = TaskEpisode(TaskSetup("LoopingMaze", **SHORT))
    episode.begin(0)
    renderer = Renderer("auto")
    with pytest.warns(MapWarning, match=r"cannot render here \(no library\); expected MUJOCO_GL"):
        drawn = renderer.picture(episode.episode)
    assert renderer.view == "map"
    assert (renderer.picture(episode.episode) == drawn).all()
    with pytest.raises(KhepTwinError, match="MuJoCo cannot render here"):
        Renderer("scene").picture(episode.episode)
    with pytest.raises(KhepTwinError, match="choices: auto, scene, map"):
        Renderer("film")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("package", "module"),
    [("gymnasium", "gymnasium"), ("gymnasium", "gymnasium_vector"), ("pettingzoo", "pettingzoo")],
)
def test_without_its_package_a_form_names_the_extra_in_one_line(
    package: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if package == "pettingzoo":
        pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    real = builtins.__import__

    def hidden(name: str, *args: Any) -> Any:
        if name.split(".")[0] == package:
            raise ModuleNotFoundError(f"No module named {name!r}")
        return real(name, *args)

    monkeypatch.delitem(sys.modules, f"khep_twin.envs.{module}", raising=False)
    monkeypatch.setattr(builtins, "__import__", hidden)
    with pytest.raises(
        MissingExtraError, match=rf"^{package} is not installed; .* pip install .*'{package}<2"
    ):
        importlib.import_module(f"khep_twin.envs.{module}")


PAGE = Path(__file__).parents[2] / "docs/environments.md"
PROGRAMS = re.findall(r"(?<!-->\n\n)```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
"""All but those under a comment that says why they are not run."""


# The way to a picture depends on the machine's GL, of which each has its own complaints.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_the_programs_of_the_page_run(number: int) -> None:
    pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")
    exec(compile(PROGRAMS[number], str(PAGE), "exec"), {})


@pytest.mark.parametrize("seed", [1.7, "abc", -1, 2**63])
def test_an_odd_seed_of_an_episode_is_refused_and_numpys_integers_are_taken(seed: object) -> None:
    gymnasium = pytest.importorskip("khep_twin.envs.gymnasium")
    vector = pytest.importorskip("khep_twin.envs.gymnasium_vector")
    options: dict[str, Any] = {"planar": True, "compiled": False}
    vectorized = vector.KheperaVectorEnvironment(2, **options)
    vectorized.reset(seed=np.int64(3))
    for opened in (gymnasium.KheperaEnvironment(**options), vectorized):
        with pytest.raises(ValueError, match=r"options: seed = .*; expected an integer from 0 to 2\*\*63-1"):
            opened.reset(options={"seed": seed})
        opened.reset(options={"seed": np.int64(3)})
        opened.close()
