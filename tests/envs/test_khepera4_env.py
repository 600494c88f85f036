"""Tasks of the Khepera IV as environments, in MuJoCo and in the plane."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

import khep_twin  # noqa: E402
from khep_twin import World  # noqa: E402
from khep_twin.envs import KheperaEnvironment, ParallelEnvironment, TaskEpisode, TaskSetup, make_vec  # noqa: E402
from khep_twin.envs.dm_env import load  # noqa: E402
from khep_twin.errors import KhepTwinError  # noqa: E402
from khep_twin.robots.khepera4.model import KHEPERA_4  # noqa: E402
from khep_twin.robots.khepera4.registers import Control, DspicRegister  # noqa: E402


@pytest.mark.parametrize("task", KHEPERA_4.tasks)
def test_an_environment_passes_gymnasiums_own_check(task: str) -> None:
    assert khep_twin.__version__  # which registers it
    check_env(gymnasium.make(f"khep_twin/{task}-v0", seconds=1).unwrapped, skip_render_check=True)


def test_ultrasonic_distances_of_an_episode_are_those_of_a_world() -> None:
    episode = TaskEpisode(TaskSetup("KheperaIVObstacleAvoidance", start=(700, 500, 30), compiled=False))
    episode.begin(seed=2)
    (result,) = [episode.step([(0.5, 0.25)]) for _ in range(10)][-1]
    world = World("arena4", seed=2, compiled=False)
    world.reset(2, starts=[(700, 500, 30)])
    dspic = world.robots[0].dspic  # type: ignore[attr-defined]
    dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))
    dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT, 300 & 255, 300 >> 8, 150, 0]))
    world.advance(0.5)
    readings = world.robots[0].readings()
    labels = episode.setup.task.labels
    assert labels[8:13] == tuple(
        f"ultrasonic {name}" for name in ("left", "front left", "front", "front right", "right")
    )
    np.testing.assert_allclose(
        result.observation[8:13], np.clip(np.array(readings["ultrasonic"]) / 125 - 1, -1, 1)
    )
    np.testing.assert_allclose(
        result.observation[:8], np.array(readings["proximity"][:8]) / 511.5 - 1, atol=1e-6
    )


def test_driving_ahead_is_rewarded_and_standing_at_a_wall_is_not() -> None:
    for planar in (False, True):
        environment = KheperaEnvironment(
            "KheperaIVObstacleAvoidance", noise=False, start=(1000, 300, 90), planar=planar
        )
        environment.reset()
        rewards = [environment.step(np.array([0.5, 0.5]))[1] for _ in range(40)]
        assert rewards[-1] == pytest.approx(0.5, abs=0.05)
        environment.reset(options={"start": (1000, 1925, 90)})
        rewards = [environment.step(np.array([0.5, 0.5]))[1] for _ in range(40)]
        assert max(rewards[20:]) < 0.05


@pytest.mark.parametrize("planar", [False, True])
def test_a_controller_that_steers_by_the_ground_sensors_follows_the_line(planar: bool) -> None:
    environment = KheperaEnvironment("KheperaIVLineFollowing", seconds=20, planar=planar)
    observation, _ = environment.reset(seed=1)
    total, is_truncated = 0.0, False
    while not is_truncated:
        left, right = observation[1], observation[2]
        turn = 0.12 * float(np.sign(right - left))
        observation, reward, _, is_truncated, _ = environment.step(np.array([0.3 - turn, 0.3 + turn]))
        total += reward
    assert total / 400 > 0.15


def test_a_task_of_a_khepera_runs_with_a_khepera_iv() -> None:
    vector = make_vec("khep_twin/ObstacleAvoidance-v0", 2, playpen="arena4", planar=True)
    observations, _ = vector.reset(seed=1)
    assert observations.shape == (2, 10)
    assert vector.unwrapped.labels[:2] == ("proximity back_left", "proximity left")
    time_step = load("LightSeeking", playpen="arena4", seconds=1).reset()
    assert [*time_step.observation] == ["proximity", "light", "speed"]


def test_a_term_that_a_model_lacks_is_refused() -> None:
    with pytest.raises(KhepTwinError, match="observation term 'ground': unknown"):
        TaskSetup("KheperaIVLineFollowing", playpen="obstacles")
    with pytest.raises(KhepTwinError, match="task 'Line': unknown"):
        TaskSetup("Line")


def test_two_khepera_ivs_start_where_those_of_the_playpen_do() -> None:
    environment = ParallelEnvironment(
        "KheperaIVLineFollowing", robots=2, playpen="arena4-two", seconds=1, compiled=False
    )
    _, infos = environment.reset(seed=1)
    assert [info["x"] for info in infos.values()] == pytest.approx([0.5, 1.5])
    assert [np.cos(info["heading"]) for info in infos.values()] == pytest.approx([1, -1])
    setup = TaskSetup(
        "KheperaIVObstacleAvoidance", playpen="arena4-two", robots=2, randomize={"starts": (50, 9)}
    )
    (x, *_), (other_x, *_) = setup.beginning(seed=1).options.start
    assert 450 <= x <= 550
    assert 1450 <= other_x <= 1550


def test_robots_without_room_around_their_common_start_are_refused() -> None:
    setup = TaskSetup("KheperaIVObstacleAvoidance", robots=2, randomize={"starts": (50, 180)})
    with pytest.raises(KhepTwinError, match=r"arena4: robot 1 at .* overlaps robot 2"):
        setup.beginning(seed=1)


@pytest.mark.parametrize("planar", [False, True])
def test_a_drawn_delay_postpones_the_speeds_of_a_khepera_iv(planar: bool) -> None:
    def speeds(task: str, delay: float) -> list[float]:
        randomize = {"delay": (delay, delay)}
        environment = KheperaEnvironment(task, randomize=randomize, planar=planar, compiled=False)
        environment.reset(seed=1)
        column = environment.labels.index("speed left")
        return [float(environment.step(np.array([0.3, 0.3]))[0][column]) for _ in range(3)]

    for task in KHEPERA_4.tasks:
        prompt, late = speeds(task, 0.0), speeds(task, 0.05)
        assert late[0] == pytest.approx(0, abs=0.01)
        np.testing.assert_allclose(late[1:], prompt[:2], atol=0.01)
