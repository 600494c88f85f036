"""Episodes at a line: bitwise equal to those of a host on khep:// that computes in no time."""

import math
import pickle

import numpy as np
import pytest
from numba_marks import KINDS
from numpy.typing import NDArray

from khep_twin.envs.task_episode import TaskEpisode
from khep_twin.envs.task_setup import TaskSetup
from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import ConstantSpeed, Function, Policy
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.fitness import obstacle_avoidance
from khep_twin.episodes.line import MeasuredCycle, longest_cycle_ns
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.units import COUNTS_LIMIT

SCENE = Playpen.load("obstacles")
MODES = {9600: 1, 38400: 3}
PERIOD = 0.02
LINES = [(9600, "N"), (9600, "NO"), (38400, "N"), (38400, "NO")]


def decide(
    proximity: NDArray[np.int64], ambient: NDArray[np.int64], memory: NDArray[np.float64], genes: object
) -> tuple[float, float]:
    memory[0] += 1.0
    turn = (proximity[3] - proximity[2]) / 60 + math.sin(memory[0] / 9)
    return 12 - turn - ambient[1] / 200, 9 + turn


def host_run(baud: int, requests: str, cycles: int) -> tuple[int, tuple[float, float, float], float]:
    """Return time [ns], pose and mean fitness of a host that runs cycles on khep://."""
    fitness: list[float] = []
    memory, dark = np.zeros(1), np.zeros(8, np.int64)
    twin = open_twin(SCENE, TwinOptions(seed=3, mode=MODES[baud]))
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
        for _ in range(cycles):
            start_s = robot.time
            proximity = np.array(robot.proximity())
            ambient = np.array(robot.ambient()) if "O" in requests else dark
            left, right = map(round, decide(proximity, ambient, memory, None))
            robot.set_speed(left, right)
            fitness.append(float(obstacle_avoidance(left, right, max(proximity) / COUNTS_LIMIT)))
            if (pause_s := start_s + PERIOD - robot.time) > 0:
                robot.sleep(pause_s)
        return twin.world.time_ns, twin.robot.pose, float(np.mean(fitness))


def without_light(
    proximity: NDArray[np.int64], ambient: NDArray[np.int64], memory: NDArray[np.float64], genes: object
) -> tuple[float, float]:
    turn = (proximity[3] - proximity[2]) / 60
    memory[0] += 1.0
    turn += math.sin(memory[0] / 9)
    return 12 - turn, 9 + turn


@pytest.mark.share(6)
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize(("baud", "requests"), LINES)
def test_a_function_at_a_line_drives_like_a_host(baud: int, requests: str, compiled: bool) -> None:
    time_ns, pose, fitness = host_run(baud, requests, 60)
    function = Function(decide if "O" in requests else without_light, 1, requests)
    episode = Episode(setup := EpisodeSetup(SCENE), function, compiled=compiled)
    episode.begin(3, EpisodeOptions(line=baud))
    episode.step(time_ns // setup.step_ns)
    assert episode.pose == pose
    assert episode.metrics()["obstacle_avoidance"] == pytest.approx(fitness, rel=1e-12)


@pytest.mark.share(3)
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("line", [9600, 38400, MeasuredCycle(0.013, 0.03)])
def test_a_policy_at_a_line_drives_like_a_function(
    line: int | MeasuredCycle, planar: bool, compiled: bool
) -> None:
    setup, memories = EpisodeSetup(SCENE, planar=planar), np.zeros((3, 1))

    def policy(
        proximity: NDArray[np.int64], ambient: NDArray[np.int64], which: NDArray[np.int64]
    ) -> list[tuple[float, float]]:
        readings = zip(proximity, ambient, which.tolist(), strict=True)
        return [decide(proximities, light, memories[index], None) for proximities, light, index in readings]

    results = [
        rollout(setup, driver, [3, 4, 5], 1.0, line=line, threads=1, compiled=compiled)
        for driver in (Policy(policy), Function(decide, 1))
    ]
    assert results[0].poses.tobytes() == results[1].poses.tobytes()
    for name, values in results[0].metrics.items():
        assert values.tobytes() == results[1].metrics[name].tobytes(), name


def test_a_measured_cycle_without_delay_equals_no_line() -> None:
    results = [
        rollout(SCENE, Function(decide, 1), [0], 1.0, line=line, compiled=False)
        for line in (None, MeasuredCycle(0.0, PERIOD))
    ]
    assert results[0].poses.tobytes() == results[1].poses.tobytes()
    for name, values in results[0].metrics.items():
        assert values.tobytes() == results[1].metrics[name].tobytes(), name


def test_a_slow_line_delays_cycles_and_a_late_effect_changes_the_path() -> None:
    ends = [
        rollout(SCENE, Function(decide, 1), [0], 3.0, line=line, compiled=False).poses.tobytes()
        for line in (None, 9600, 38400, MeasuredCycle(0.0, 0.06), MeasuredCycle(0.03, 0.06))
    ]
    assert len(set(ends)) == len(ends)
    assert 40e6 < longest_cycle_ns(9600, "N") < 80e6
    assert longest_cycle_ns(9600, "NOH") > 2 * longest_cycle_ns(9600, "N")


@pytest.mark.parametrize("compiled", KINDS)
def test_in_the_plane_sensors_converted_one_by_one_read_the_same(compiled: bool) -> None:
    setups = [EpisodeSetup(SCENE, planar=True, at_line=at_line) for at_line in (False, True)]
    assert setups[1].step_ns == pickle.loads(pickle.dumps(setups[1])).step_ns == setups[0].step_ns // 4
    results = [rollout(setup, Function(decide, 1), [3, 4], 2.0, compiled=compiled) for setup in setups]
    assert results[0].poses.tobytes() == results[1].poses.tobytes()
    for name, values in results[0].metrics.items():
        assert values.tobytes() == results[1].metrics[name].tobytes(), name


def test_constant_speeds_have_no_requests_and_ignore_the_line() -> None:
    poses = [
        rollout(SCENE, ConstantSpeed(5, 4), [0], 1.0, line=line, compiled=False).poses.tobytes()
        for line in (None, 9600)
    ]
    assert poses[0] == poses[1]


@pytest.mark.parametrize("compiled", KINDS)
def test_a_task_at_a_line_observes_and_drives_like_a_host(compiled: bool) -> None:
    setup = TaskSetup(
        "ObstacleAvoidance", period_ns=50_000_000, line=38400, compiled=compiled, normalize=False
    )
    episode = TaskEpisode(setup)
    observations = [episode.begin(3)[0]] + [
        episode.step([(12 - index % 7, 5 + index % 5)])[0].observation for index in range(12)
    ]
    (robot,) = setup.start_playpen(3).robots
    twin = open_twin(setup.playpen.model_copy(update={"robots": (robot,)}), TwinOptions(seed=3, mode=3))
    with Khepera(Serial.of(twin, timeout=1.0)) as khepera:
        last_position = None
        for index, expected in enumerate(observations):
            start_s = khepera.time
            proximity, position = khepera.proximity(), khepera.position()
            assert expected[:8].tolist() == list(proximity)
            if last_position is not None:
                speeds = [
                    (current - previous) / 5
                    for current, previous in zip(position, last_position, strict=True)
                ]
                assert expected[8:].tolist() == pytest.approx(speeds, abs=1e-6)
            last_position = position
            khepera.set_speed(12 - index % 7, 5 + index % 5)
            khepera.sleep(start_s + 0.05 - khepera.time)


@pytest.mark.parametrize("line", [0, -9600, 9600.5, True, "9600"])
def test_an_invalid_line_is_refused(line: object) -> None:
    with pytest.raises(ValueError, match="expected a speed in baud, such as 9600, or a MeasuredCycle"):
        EpisodeOptions(line=line)  # type: ignore[arg-type]


@pytest.mark.parametrize(("delay", "period"), [(-0.01, 0.02), (0.03, 0.02), (0.0, math.inf), (math.nan, 0.1)])
def test_invalid_times_of_a_cycle_are_refused(delay: float, period: float) -> None:
    with pytest.raises(ValueError, match="expected a delay from 0 to the period"):
        MeasuredCycle(delay, period)


def test_a_period_too_short_for_the_line_is_refused_with_the_shortest_one() -> None:
    message = (
        r"line = 9600: a cycle of N, H and D takes up to \d+ ms; expected period_ns = 120_000_000 or more"
    )
    with pytest.raises(ValueError, match=message):
        TaskSetup("ObstacleAvoidance", line=9600)
    assert TaskSetup("ObstacleAvoidance", line=9600, period_ns=120_000_000).n_steps == 500
