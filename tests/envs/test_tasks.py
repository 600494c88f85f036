"""Tasks and their episodes: observations and rewards by seed, without a serial line and in worlds."""

import dataclasses

import numpy as np
import pytest
from numba_marks import with_numba

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, PROXIMITY
from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup, with_robots
from khep_twin.envs.tasks import TASKS, TERMS, State, Task, avoiding, avoiding_either_way
from khep_twin.episodes import version_check
from khep_twin.episodes.stepping import drive
from khep_twin.errors import DivergedError, KhepTwinError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import anywhere
from khep_twin.world import World

SHORT = {"seconds": 0.5, "compiled": False}


def driven(
    episode: TaskEpisode, seed: int, speeds: tuple[float, float] = (0.6, 0.35)
) -> list[tuple[bytes, float]]:
    """Return an episode's observations and rewards, from start to end."""
    steps = [(episode.begin(seed)[0].tobytes(), 0.0)]
    while not episode.over:
        (outcome,) = episode.step([speeds])
        steps.append((outcome.observation.tobytes(), outcome.reward))
    return steps


@pytest.mark.parametrize("normalize", [True, False])
@pytest.mark.parametrize("name", TASKS)
def test_what_is_seen_lies_within_its_bounds_and_has_a_label_for_each_number(
    name: str, normalize: bool
) -> None:
    setup = TaskSetup(name, normalize=normalize, **SHORT)
    low, high = setup.task.bounds(normalize)
    episode = TaskEpisode(setup)
    observation = episode.begin(3)
    for speeds in ((20, 20), (-127, 127), (127, -127)):
        outcome = episode.step([speeds])[0]
        assert 0 <= outcome.reward <= 1
        observation.append(outcome.observation)
    for row in observation:
        assert row.dtype == np.float32
        assert len(row) == len(setup.task.labels) == len(low)
        assert (low <= row).all()
        assert (row <= high).all()


def test_an_episode_depends_on_its_seed_and_actions_alone() -> None:
    setup = TaskSetup("Homing", **SHORT)
    episode = TaskEpisode(setup)
    first = driven(episode, 5)
    other = driven(episode, 6)
    assert other != first
    assert driven(episode, 5) == first
    assert driven(TaskEpisode(setup), 5) == first


def test_an_episode_without_a_line_is_the_same_as_in_a_world() -> None:
    setup = TaskSetup("LoopingMaze", robots=2, **SHORT)
    episode, world = TaskEpisode(setup), World(setup.start_playpen(2), seed=2, unpaced=True)
    episode.begin(2)
    for period in range(5):
        for robot, speeds in zip(world.robots, ((10, -4), (20, 12)), strict=True):
            drive(world.simulation.robots.state_of(robot.index), *speeds)
        world.advance_to((period + 1) * setup.period_ns)
        episode.step([(0.5, -0.2), (1.0, 0.6)])
        assert [board.tolist() for board in episode.registers] == [
            robot.registers.tolist() for robot in world.robots
        ]
    # The models are compiled with the robots at different places, which changes last bits.
    assert episode.data.qpos.tolist() == pytest.approx(world.data.qpos.tolist(), abs=1e-9)


@with_numba
def test_a_compiled_episode_is_the_same_as_a_plain_one() -> None:
    plain = TaskSetup("LightSeeking", seconds=0.5, compiled=False, vary=True)
    compiled = TaskSetup("LightSeeking", seconds=0.5, compiled=True, vary=True)
    assert driven(TaskEpisode(plain), 8) == driven(TaskEpisode(compiled), 8)


def test_speeds_and_observations_are_normalized_by_the_top_speed_and_the_calibration() -> None:
    setup = TaskSetup("LightSeeking", **SHORT)
    assert setup.speeds([0.5, -2]).tolist() == [10, -20]
    assert TaskSetup("LightSeeking", normalize=False, **SHORT).speeds([10, -40]).tolist() == [10, -20]
    registers = np.zeros(100, np.int64)
    registers[PROXIMITY[1]] = 1023
    registers[AMBIENT[0] : AMBIENT[3] + 1] = [500, 50, 275, 600]  # dark, brightest, between, darker than dark
    state = State(registers, 10, -30, dark=500, floor=50, at_goal=False, charge=0.25)
    numbers = dict(zip(setup.task.labels, setup.task.observe(state).tolist(), strict=True))
    sensors = list(TERMS["light"].names)
    assert [numbers[f"proximity {name}"] for name in sensors[:2]] == [-1, 1]
    assert [numbers[f"light {name}"] for name in sensors[:4]] == [-1, 1, 0, -1]
    assert (numbers["speed left"], numbers["speed right"]) == (0.5, -1)
    assert TERMS["charge"].observe(state, True).tolist() == [-0.5]
    raw = setup.task.observe(state, normalize=False).tolist()
    assert raw == [0, 1023, *[0] * 6, 500, 50, 275, 600, *[0] * 4, 10, -20]


def test_vary_gives_each_episode_another_robot() -> None:
    options = {**SHORT, "noise": False}
    same = TaskEpisode(TaskSetup("LightSeeking", **options))
    vary = TaskEpisode(TaskSetup("LightSeeking", vary=True, **options))
    assert driven(vary, 1) != driven(same, 1)
    assert driven(vary, 1) == driven(vary, 1)


def test_starts_anywhere_differ_by_seed_and_have_room() -> None:
    episode = TaskEpisode(TaskSetup("ObstacleAvoidance", **SHORT))
    places = set()
    for seed in range(5):
        episode.begin(seed)
        places.add(episode.poses[0])
    assert len(places) == 5


def test_robots_that_start_anywhere_do_not_overlap() -> None:
    scene = anywhere(with_robots(Playpen.load("default"), 6), 1)
    assert playpen.parse(playpen.dump(scene), "scene") == scene  # which refuses overlaps


def test_where_there_is_no_room_for_all_an_error_says_so() -> None:
    crowd = with_robots(Playpen.load("default"), 200)
    with pytest.raises(PlaypenError, match=r"no room for robot \d+ was found in 1000 tries"):
        anywhere(crowd, 0)


def test_a_charge_runs_out_away_from_home_and_is_full_again_there() -> None:
    task = dataclasses.replace(TASKS["Homing"], charge_s=0.2)
    episode = TaskEpisode(TaskSetup(task, normalize=False, **SHORT))
    episode.begin(0)
    charges, ends = [], []
    for _ in range(4):
        (outcome,) = episode.step([(0, 0)])
        charges.append(float(outcome.observation[-1]))
        ends.append(outcome.terminated)
    assert charges == pytest.approx([0.75, 0.5, 0.25, 0])
    assert ends == [False, False, False, True]
    home = TaskEpisode(TaskSetup(dataclasses.replace(task, reach_mm=1000.0), **SHORT))
    home.begin(0)
    (outcome,) = home.step([(1, 1)])
    assert outcome.observation[-1] == 1
    assert outcome.reward == 0


def test_only_beside_the_cylinder_is_there_a_reward() -> None:
    scene = Playpen.load("wall-or-cylinder")
    for y_mm, reward in ((230.0 - 60, 1.0), (230.0 - 80, 0.0)):
        place = {"x_mm": 250.0, "y_mm": y_mm, "heading_deg": 0.0, "spots": ()}
        robots = (scene.robots[0].model_copy(update=place),)
        episode = TaskEpisode(
            TaskSetup("WallOrCylinder", playpen=scene.model_copy(update={"robots": robots}), **SHORT)
        )
        episode.begin(0)
        assert episode.step([(0, 0)])[0].reward == reward


def test_avoiding_is_rewarded_by_what_the_wheels_did() -> None:
    def state(left: float, right: float, count: int) -> State:
        return State(np.full(100, count), left, right, 500, 50, False, 1)

    assert avoiding(state(20, 20, 0)) == 1
    assert avoiding(state(10, 10, 0)) == 0.5
    assert avoiding(state(20, -20, 0)) == 0
    assert avoiding(state(-20, -20, 0)) == 0
    assert avoiding_either_way(state(-20, -20, 0)) == 1
    assert avoiding(state(20, 20, 1023)) == 0


def test_speeds_that_are_no_numbers_end_the_episode_and_the_next_one_begins() -> None:
    episode = TaskEpisode(TaskSetup("ObstacleAvoidance", **SHORT))
    before = driven(episode, 1)
    episode.begin(1)
    with pytest.raises(DivergedError, match="expected finite numbers"):
        episode.step([(float("nan"), 0)])
    assert driven(episode, 1) == before


def test_an_episode_that_is_over_or_not_begun_takes_no_step() -> None:
    episode = TaskEpisode(TaskSetup("ObstacleAvoidance", **SHORT))
    with pytest.raises(ValueError, match=r"over, or none has started; expected begin\(\)"):
        episode.step([(0, 0)])
    driven(episode, 0)
    with pytest.raises(ValueError, match=r"^the episode is over, or none has started; expected begin\(\)"):
        episode.step([(0, 0)])


def test_errors_of_wrong_words_name_the_right_ones() -> None:
    with pytest.raises(KhepTwinError, match="did you mean 'Homing'"):
        TaskSetup("Hooming")
    with pytest.raises(KhepTwinError, match="did you mean 'proximity'"):
        Task("mine", "obstacles", ("proximty",), avoiding)
    with pytest.raises(KhepTwinError, match="no patch or cylinder 'charger'"):
        TaskSetup("Homing", playpen="obstacles", compiled=False)
    with pytest.raises(ValueError, match="whole ticks"):
        TaskSetup("Homing", period_ns=25_000_000)
    with pytest.raises(KhepTwinError, match="did you mean 'anywhere'"):
        dataclasses.replace(TASKS["Homing"], starts="anywher")  # type: ignore[arg-type]
    with pytest.raises(KhepTwinError, match=r"charge_s = -1; expected a finite number from 0"):
        dataclasses.replace(TASKS["Homing"], charge_s=-1)
    with pytest.raises(ValueError, match="noise = 'off'; expected True or False"):
        TaskSetup("Homing", noise="off")  # type: ignore[arg-type]
    with pytest.raises(
        PlaypenError, match="default: robot 1 has no spots; expected spots, at which 2 robots"
    ):
        TaskSetup("LoopingMaze", playpen="default", robots=2)
    with pytest.raises(ValueError, match="0 robots"):
        TaskSetup("Homing", robots=0)


def test_only_the_known_pair_of_mujoco_and_dm_control_is_taken() -> None:
    assert (
        version_check.find_problem("3.17.0", "1.0.50") == version_check.find_problem("3.17.3", "1.0.50") == ""
    )
    for mujoco, dm_control in (("4.0.0", "1.0.50"), ("3.17.0", "1.0.49"), ("3.1.7", "1.0.50")):
        assert version_check.find_problem(mujoco, dm_control).endswith(
            " --no-deps 'mujoco~=3.17.0' dm-control==1.0.50"
        )


def test_a_period_that_was_refused_is_none_of_the_episodes() -> None:
    episode = TaskEpisode(TaskSetup("ObstacleAvoidance", planar=True, compiled=False))
    episode.begin(1)
    with pytest.raises(DivergedError):
        episode.step([[np.nan, 0.0]])
    assert episode.time_s == 0
