"""Episodes from logs: equal to those of the environment, to the last bit; missing data are one line."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from log_rewriting import rewritten
from relay_logs import relayed

from khep_twin.envs.task_episode import TaskEpisode, TaskSetup
from khep_twin.envs.tasks import TASKS, State, find_task
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import LogError
from khep_twin.interventions.move_robot import place_robot
from khep_twin.lab.dataset.episodes import OfflineEpisode, episodes_of
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

MS = 1_000_000
SPEEDS = [(0.5, 0.5), (1.0, -0.25), (-0.6, -0.5), (0.0, 0.75), (0.3, 0.35)] * 4


def recorded(path: Path, setup: TaskSetup, seed: int, actions: list[tuple[float, float]]) -> Path:
    """Log an environment's episode."""
    (robot,) = setup.start_playpen(seed).robots
    world = EpisodeSetup(setup.playpen, period_ns=setup.period_ns)
    episode = Episode(world, compiled=False, observed=True)
    episode.begin(seed, EpisodeOptions(start=(robot.x_mm, robot.y_mm, robot.heading_deg)))
    with Twin(episode.world, episode.world.robots, TwinOptions(seed=seed)) as twin:
        twin.record(path, facts={"line": "none"})
        for action in actions:
            episode.drive(*setup.speeds(action))
            episode.step(setup.steps_per_period)
    return path


def one(path: Path, name: str, period_ns: int = 50 * MS) -> OfflineEpisode:
    (episode,) = episodes_of(path, find_task(name), period_ns)
    return episode


def refusal(path: Path, name: str = "ObstacleAvoidance", period_ns: int = 50 * MS) -> str:
    with pytest.raises(LogError) as caught:
        list(episodes_of(path, find_task(name), period_ns))
    (line,) = str(caught.value).splitlines()
    return line


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("name", "period_ms"),
    [
        *((name, period_ms) for name in ("Homing", "LightSeeking") for period_ms in (20, 50, 60)),
        *(("KheperaIVObstacleAvoidance", period_ms) for period_ms in (20, 60)),
        ("KheperaIVLineFollowing", 40),
    ],
)
def test_a_logged_episode_equals_that_of_the_environment(name: str, period_ms: int, tmp_path: Path) -> None:
    setup = TaskSetup(name, period_ns=period_ms * MS, seconds=period_ms / 50, compiled=False)
    path = recorded(tmp_path / "run.mcap", setup, 3, SPEEDS)
    logged = one(path, name, period_ms * MS)
    replayed = TaskEpisode(setup)
    observations, rewards, poses = [replayed.begin(3)[0]], list[float](), [replayed.poses[0]]
    for action in SPEEDS:
        (result,) = replayed.step([action])
        observations.append(result.observation)
        rewards.append(result.reward)
        poses.append(replayed.poses[0])
    assert logged.observations.dtype == np.float32
    assert logged.observations.tolist() == np.stack(observations).tolist()
    assert logged.rewards.tolist() == rewards
    np.testing.assert_allclose(logged.actions, SPEEDS, atol=1e-7)
    assert logged.truncations.tolist() == [False] * 19 + [True]
    assert not logged.terminations.any()
    columns = np.column_stack([logged.infos[name] for name in ("x", "y", "heading")])
    # Half-way between two samples a pose is interpolated.
    np.testing.assert_allclose(columns[:, :2], np.array(poses)[:, :2], atol=1e-4)
    np.testing.assert_allclose(np.cos(columns[:, 2] - np.array(poses)[:, 2]), 1, atol=1e-4)
    np.testing.assert_allclose(columns[::2], np.array(poses)[::2], atol=1e-8)
    assert logged.infos["time"].tolist() == [number * period_ms / 1e3 for number in range(21)]


def test_a_host_on_the_line_that_sends_speeds_every_50_ms_gives_the_boards_own_readings(
    tmp_path: Path,
) -> None:
    path, task = tmp_path / "run.mcap", TASKS["LightSeeking"]
    setup = TaskSetup(task, compiled=False)
    encoders, registers = list[tuple[int, int]](), list[list[int]]()
    with open_twin("light-seeking", TwinOptions(seed=2, log=str(path))) as twin:
        for number in range(21):
            board = twin.world.simulation.robots.record_of(0)["registers"].tolist()
            registers.append(board)
            encoders.append((board[0], board[14]))
            left, right = SPEEDS[number % 20]
            twin.robot.send(f"D,{left * 20:.0f},{right * 20:.0f}\n".encode())
            twin.advance_to((number + 1) * 50 * MS)
    logged = one(path, "LightSeeking")
    speeds = [(0.0, 0.0), *(np.diff(encoders, axis=0) / 5).tolist()]
    states = [
        State(np.array(board), left, right, setup.dark, setup.floor, False, 1.0)
        for board, (left, right) in zip(registers, speeds, strict=True)
    ]
    assert logged.observations[:21].tolist() == np.stack([task.observe(state) for state in states]).tolist()
    assert logged.rewards[:20].tolist() == [task.reward(state) for state in states[1:]]
    np.testing.assert_allclose(logged.actions[:20], SPEEDS, atol=1e-7)


def test_an_empty_charge_terminates_an_episode_and_the_time_limit_truncates_it(tmp_path: Path) -> None:
    setup = TaskSetup("Homing", seconds=2.0, compiled=False)
    path = recorded(tmp_path / "run.mcap", setup, 1, [(0.0, 0.0)] * 40)
    away = dataclasses.replace(setup.task, reach_mm=0.0, charge_s=0.5, seconds=0.8)
    episodes = list(episodes_of(path, away, 50 * MS))
    assert [len(episode.rewards) for episode in episodes] == [10, 10, 8]
    assert [episode.terminations[-1] for episode in episodes] == [True, True, False]
    assert [episode.truncations[-1] for episode in episodes] == [False, False, True]
    assert episodes[0].observations[:, -1].tolist() == pytest.approx(np.linspace(1, -1, 11).tolist())
    long = dataclasses.replace(away, charge_s=20.0)
    assert [len(episode.rewards) for episode in episodes_of(path, long, 50 * MS)] == [16, 16, 8]


def test_each_robot_has_its_episodes_without_the_periods_in_which_it_was_carried_or_sought_a_position(
    tmp_path: Path,
) -> None:
    one_robot = Playpen.load("obstacles")
    (robot,) = one_robot.robots
    robots = (robot, robot.model_copy(update={"x_mm": 300.0, "y_mm": 300.0}))
    path = tmp_path / "run.mcap"
    two = one_robot.model_copy(update={"robots": robots})
    with open_twin(two, TwinOptions(seed=3, robot=None, log=str(path))) as twin:
        twin.robots[0].send(b"D,5,5\n")
        twin.robots[1].send(b"D,2,-2\n")
        twin.advance_to(520 * MS)
        place_robot(twin.world, 0, 200.0, 300.0, 90.0)
        twin.robots[1].send(b"C,0,0\n")
        twin.advance_to(1000 * MS)
        twin.robots[1].send(b"D,1,1\n")
        twin.advance_to(1500 * MS)
    episodes = list(episodes_of(path, find_task("ObstacleAvoidance"), 50 * MS))
    assert [(episode.source["robot"], *episode.infos["time"][[0, -1]].tolist()) for episode in episodes] == [
        ("khepera0", 0.0, 0.5),
        ("khepera0", 0.55, 1.5),
        ("khepera1", 0.0, 0.5),
        ("khepera1", 1.0, 1.5),
    ]
    assert np.abs(np.diff(episodes[1].infos["x"])).max() < 0.01
    assert episodes[2].actions[0].tolist() == pytest.approx([0.1, -0.1])
    (second,) = {
        episode.source["robot"]
        for episode in episodes_of(path, find_task("ObstacleAvoidance"), 50 * MS, "khepera1")
    }
    assert second == "khepera1"


def test_a_log_without_the_data_for_a_task_is_refused_in_one_line(tmp_path: Path) -> None:
    setup = TaskSetup("ObstacleAvoidance", seconds=0.2, compiled=False)
    path = recorded(tmp_path / "run.mcap", setup, 1, [(0.5, 0.5)] * 4)
    assert "no patch or cylinder 'charger', the goal of Homing; " in refusal(path, "Homing")
    assert "control period of 25 ms; expected whole ticks of 10 ms" in refusal(path, period_ns=25 * MS)
    assert "that divide the task's time limit of 60 s" in refusal(path, period_ns=70 * MS)
    assert "no control period of 500 ms with all data" in refusal(path, period_ns=500 * MS)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[:-1000])
    assert refusal(torn).startswith(f"{torn}: no whole log: ")
    missing = tmp_path / "none.mcap"
    assert refusal(missing).startswith(f"{missing}: cannot be read: No such file or directory; to make one: ")


def test_a_log_with_odd_samples_is_refused_in_one_line(tmp_path: Path) -> None:
    setup = TaskSetup("ObstacleAvoidance", seconds=0.2, compiled=False)
    path, target = recorded(tmp_path / "run.mcap", setup, 1, [(0.5, 0.5)] * 4), tmp_path / "odd.mcap"

    def late(topic: str, time_ns: int) -> int:
        return time_ns + MS if time_ns == 60 * MS else time_ns

    assert refusal(rewritten(path, target, time=late)).endswith(
        "odd.mcap: no sample at 0.06 s; expected one every 20 ms"
    )
    floats = rewritten(path, target, rename=lambda topic: topic.replace("/registers", "/board"))
    assert refusal(floats).endswith(
        "odd.mcap: no registers of khepera0; expected the log of a twin or of a real robot"
    )
    bare = rewritten(path, target, attachment=lambda name, data: None if "calibration" in name else data)
    assert refusal(bare).endswith("odd.mcap: no calibration of khepera0; expected a log of khep-twin")


# Real robots --------------------------------------------------------------------------------------------


REPLIES = {
    "N": "n,0,100,200,300,400,500,600,1023",
    "O": "o,450,450,450,450,450,450,450,50",
    "E": "e,4,-2",
}


def write_replies(path: Path, *cycles: tuple[int, str]) -> Path:
    """Log a real robot's serial line: commands at times [ms], and their replies 5 ms later."""
    messages: list[tuple[int, bool, bytes]] = []
    for time_ms, command in cycles:
        reply = REPLIES.get(command, command[0].lower())
        messages += [(time_ms, True, f"{command}\n".encode()), (time_ms + 5, False, f"{reply}\r\n".encode())]
    return relayed(path, messages)


def polled(first_ms: int, count: int, every_ms: int = 50) -> list[tuple[int, str]]:
    """Return the commands of a host that sends N, E and another D in each cycle."""
    return [
        (first_ms + cycle * every_ms + late_ms, command)
        for cycle in range(count)
        for late_ms, command in ((0, "N"), (12, "E"), (24, f"D,{cycle},-30"))
    ]


def test_a_real_robot_has_the_readings_that_its_host_requested(tmp_path: Path) -> None:
    episode = one(write_replies(tmp_path / "real.mcap", *polled(200, 10)), "ObstacleAvoidance")
    # From the first D, at 224 ms, to the last reply, at 667 ms.
    assert episode.infos["time"].tolist() == pytest.approx([0.224 + 0.05 * border for border in range(9)])
    counts = [0, 100, 200, 300, 400, 500, 600, 1023]
    assert episode.observations[0].tolist() == pytest.approx(
        [*(2 * count / 1023 - 1 for count in counts), 0.2, -0.1]
    )
    assert episode.actions.tolist() == [pytest.approx([step / 20, -1.0]) for step in range(8)]
    assert episode.truncations.tolist() == [False] * 7 + [True]
    assert set(episode.infos) == {"time"}


def test_where_a_real_robots_host_paused_or_sought_a_position_an_episode_ends(tmp_path: Path) -> None:
    commands = [*polled(0, 10), *polled(1000, 10), (1274, "C,0,0")]
    path = write_replies(tmp_path / "real.mcap", *sorted(commands))
    episodes = list(episodes_of(path, find_task("ObstacleAvoidance"), 50 * MS))
    assert len(episodes) == 3
    assert all(episode.truncations[-1] for episode in episodes)
    assert all(np.diff(episode.infos["time"]).max() < 0.051 for episode in episodes)


def test_missing_data_of_a_real_robots_log_are_reported_in_one_line(tmp_path: Path) -> None:
    log = write_replies(tmp_path / "log.mcap", *polled(0, 10))
    assert "without replies to O (light), a calibration (light), which LightSeeking needs" in refusal(
        log, "LightSeeking"
    )
    assert "without the true pose (goal 'target'), which WallOrCylinder needs" in refusal(
        log, "WallOrCylinder"
    )
    silent = write_replies(tmp_path / "silent.mcap", (0, "N"), (100, "N"))
    assert "without replies to E (speed), commands D (speeds), which Obst" in refusal(silent)
    pause = 60 * 365 * 24 * 3600 * 1000
    years = write_replies(tmp_path / "years.mcap", *polled(0, 5), *polled(pause, 5))
    # Replies of 205 and 217 ms still cover the border at 224 ms; the log's end is its last reply.
    assert [
        len(episode.rewards) for episode in episodes_of(years, find_task("ObstacleAvoidance"), 50 * MS)
    ] == [4, 3]
    slow = write_replies(tmp_path / "slow.mcap", *polled(0, 5, every_ms=200))
    assert "no control period of 50 ms with all data for ObstacleAvoidance" in refusal(slow)
    assert len(one(slow, "ObstacleAvoidance", 200 * MS).rewards) == 3
