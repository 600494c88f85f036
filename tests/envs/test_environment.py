"""Environments: dm_env, Gymnasium and PettingZoo, by their own checks and against each other."""

import builtins
import importlib
import math
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from khep_twin.envs.renderer import MapWarning, Renderer
from khep_twin.envs.task_episode import TaskEpisode, TaskSetup, clipped
from khep_twin.envs.tasks import TASKS
from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.playpen import Spot
from khep_twin.playpen import load as load_playpen
from khep_twin.rollout import version_check

SHORT = {"seconds": 0.5, "compiled": False}


def actions(count: int, *shape: int) -> np.ndarray:
    """Speeds by chance (count, *shape, 2) [pulses/10 ms]."""
    return np.random.default_rng(0).uniform(-20, 20, (count, *shape, 2)).astype(np.float32)


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
    environment.step([5.0, 9.0])
    physics, episode = environment.physics, environment.physics.episode
    environment.step([5.0, 9.0])
    assert physics.setpoints().tolist() == [5, 9]
    assert physics.proximity().shape == physics.ambient().shape == (8,)
    assert tuple(physics.pose()) == episode.poses[0]
    # MuJoCo's bodies are where they were at the start of the last step of 2.5 ms.
    assert physics.named.data.xpos["khepera0/base"][:2] == pytest.approx(physics.pose()[:2], abs=3e-4)
    with pytest.raises(TypeError, match="same seed"):
        physics.copy()


def test_the_physics_follows_a_world_that_is_made_anew_each_time() -> None:
    scene = load_playpen("two-lamps")
    lighting = scene.lighting.model_copy(update={"mode": "sequenced"})
    environment = dm("LightSeeking", playpen=scene.model_copy(update={"lighting": lighting}))
    for _ in range(2):
        environment.reset()
        environment.step([10.0, 10.0])
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


# Gymnasium ----------------------------------------------------------------------------------------------


def gym(task: str, **options: Any) -> Any:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    import khep_twin.envs.gymnasium  # noqa: F401

    return gymnasium.make(f"khep_twin/{task}-v0", **{**SHORT, **options})


def gyms(count: int, **options: Any) -> Any:
    gymnasium = pytest.importorskip("gymnasium", reason="gymnasium, the extra [rl], is not installed")
    import khep_twin.envs.gymnasium  # noqa: F401

    return gymnasium.make_vec("khep_twin/ObstacleAvoidance-v0", num_envs=count, **{**SHORT, **options})


# It would have actions from -1 to 1; ours are in pulses.
@pytest.mark.filterwarnings("ignore:.*For Box action spaces.*:UserWarning")
@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_finds_nothing_wrong(task: str) -> None:
    environment = gym(task, view="map", render_mode="rgb_array")
    from gymnasium.utils.env_checker import check_env

    check_env(environment.unwrapped)


def test_gymnasium_is_the_same_again_by_its_seed() -> None:
    def way(seed: int) -> list[bytes]:
        environment, seen = gym("LoopingMaze", noise=True, vary=True), []
        for episode in range(2):
            seen.append(environment.reset(seed=seed if not episode else None)[0].tobytes())
            seen += [environment.step(action)[0].tobytes() for action in actions(10)]
        return seen

    assert way(1) == way(1)
    assert way(1) != way(2)
    assert way(1)[:11] != way(1)[11:]


def test_an_episode_of_gymnasium_is_repeated_by_the_seed_in_its_info() -> None:
    environment = gym("LoopingMaze")
    environment.reset(seed=1)
    seen, info = environment.reset()
    again, told = gym("LoopingMaze").reset(options={"seed": info["seed"]})
    assert (seen == again).all()
    assert info == told


@pytest.mark.parametrize("threads", [1, 3])
def test_many_in_threads_are_the_same_as_one_after_another(threads: int) -> None:
    many, each = gyms(3, threads=threads), gyms(3, vectorization_mode="sync")
    assert many.metadata["autoreset_mode"] == each.metadata["autoreset_mode"]
    assert many.observation_space == each.observation_space
    assert many.action_space == each.action_space
    pairs = [(many.reset(seed=4), each.reset(seed=4))]
    pairs += [(many.step(action), each.step(action)) for action in actions(25, 3)]  # more than two episodes
    for ours, theirs in pairs:
        for one, other in zip(ours[:-1], theirs[:-1], strict=True):
            assert (one == other).all()
        assert all((ours[-1][key] == theirs[-1][key]).all() for key in theirs[-1])
    many.close()
    each.close()


def test_lamps_that_blink_shine_the_same_in_any_number_of_threads() -> None:
    place = load_playpen("light-seeking")
    lamps = tuple(lamp.model_copy(update={"blink_period_s": 0.3, "fade_s": 0.07}) for lamp in place.lamps)
    blinking = place.model_copy(update={"lamps": lamps})

    def seen(threads: int) -> list[Any]:
        environments = gyms(4, task="LightSeeking", playpen=blinking, threads=threads, seconds=2.0)
        environments.reset(seed=1)
        found = [environments.step(action)[0] for action in actions(40, 4)]
        environments.close()
        return found

    alone, usual = seen(1), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads take turns all the time
    try:
        together = seen(4)
    finally:
        sys.setswitchinterval(usual)
    assert all((one == other).all() for one, other in zip(alone, together, strict=True))


def test_gymnasium_and_dm_env_are_the_same_episode() -> None:
    environment = dm("Homing", seed=3)
    first = environment.reset()
    seen, _ = gym("Homing").reset(options={"seed": environment.task.seed})
    assert (np.concatenate(list(first.observation.values())) == seen).all()


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
        seen = [environment.reset(seed=seed)[0]]
        for action in actions(10, 3):
            seen.append(environment.step(dict(zip(environment.agents, action, strict=True)))[0])
        assert not environment.agents
        return [row.tobytes() for rows in seen for row in rows.values()]

    assert way(1) == way(1)
    assert way(1) != way(2)


def test_robots_together_see_each_other() -> None:
    scene = load_playpen("default")
    spots = tuple(
        Spot(name=f"at-{x_mm}", x_mm=x_mm, y_mm=250, heading_deg=heading)
        for x_mm, heading in ((300, 0), (357, 180))
    )
    robot = scene.robots[0].model_copy(update={"spots": tuple(spot.name for spot in spots)})
    scene = scene.model_copy(update={"spots": spots, "robots": (robot,)})
    alone, together = zoo("LoopingMaze", 1, playpen=scene), zoo("LoopingMaze", 2, playpen=scene)
    nearest = [environment.reset(seed=0)[0]["khepera0"][:8].max() for environment in (alone, together)]
    assert nearest[0] < 0.1
    assert nearest[1] > 0.5


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
    with pytest.raises(ValueError, match=r"action .*; expected two speeds, left and right, from -20 to 20"):
        clipped(action)


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
    renderer = Renderer(episodes[0].setup.playpen, "map")
    for episode in episodes:
        episode.begin(1)
    pictures = []
    for _ in range(5):
        pictures.append(renderer.picture(episodes[0].data, episodes[0].poses))
        looked, not_looked = (episode.step([(20, 15)])[0].observation for episode in episodes)
        assert (looked == not_looked).all()
    assert all(picture.dtype == np.uint8 and picture.shape == pictures[0].shape for picture in pictures)
    assert (pictures[0] != pictures[-1]).any()


def test_without_gl_auto_is_a_map_with_a_warning_and_a_scene_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def without(*args: Any) -> None:
        raise RuntimeError("no library.")

    monkeypatch.setattr("mujoco.Renderer", without)
    episode = TaskEpisode(TaskSetup("LoopingMaze", **SHORT))
    episode.begin(0)
    renderer = Renderer(episode.setup.playpen, "auto")
    with pytest.warns(MapWarning, match=r"cannot render here \(no library\); expected MUJOCO_GL"):
        drawn = renderer.picture(episode.data, episode.poses)
    assert renderer.view == "map"
    assert (renderer.picture(episode.data, episode.poses) == drawn).all()
    with pytest.raises(KhepTwinError, match="MuJoCo cannot render here"):
        Renderer(episode.setup.playpen, "scene").picture(episode.data, episode.poses)
    with pytest.raises(KhepTwinError, match="choices: auto, scene, map"):
        Renderer(episode.setup.playpen, "film")  # type: ignore[arg-type]


@pytest.mark.parametrize(("package", "module"), [("gymnasium", "gymnasium"), ("pettingzoo", "pettingzoo")])
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
PROGRAMS = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)


# The way to a picture depends on the machine's GL, of which each has its own complaints.
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("number", range(len(PROGRAMS)))
def test_the_programs_of_the_page_run(number: int) -> None:
    pytest.importorskip("pettingzoo", reason="pettingzoo, the extra [rl], is not installed")
    exec(compile(PROGRAMS[number], str(PAGE), "exec"), {})
