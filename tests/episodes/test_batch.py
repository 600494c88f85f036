"""Batches: equal to single episodes with any number of threads; a failure affects no other episode."""

import math
import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS, with_numba

from khep_twin import playpen
from khep_twin.board.fault_injection import parse_fault
from khep_twin.board.kernel import PROXIMITY, Wheel
from khep_twin.episodes import batch
from khep_twin.episodes.batch import RolloutResult, rollout
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed, Function, Network, Policy
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import DEFAULT_OPTIONS, EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.episodes.metrics import METRICS
from khep_twin.errors import ControllerError, PlaypenError
from khep_twin.playpen import Lamp, Playpen

SCENE = Playpen.load("obstacles")
NETWORK = Network(hidden=(4,), recurrent=True, ambient=True)
N = 6
SECONDS = 1.0
CHANCE = np.random.default_rng(5)
GENES = CHANCE.normal(size=(N, NETWORK.n_genes))
STARTS = [(120.0, 290.0, 25.0), *((350.0 + 10 * i, 300.0, 60.0 * i) for i in range(N - 1))]
LAMPS = [
    tuple(lamp.model_copy(update={"x_mm": 700.0 - 20 * i, "blink_period_s": 0.1 * i}) for lamp in SCENE.lamps)
    for i in range(N)
]


def batch_of(compiled: bool, **options: Any) -> RolloutResult:
    arguments = {"genes": GENES, "starts": STARTS, "lamps": LAMPS, "options": EpisodeOptions(vary=True)}
    return rollout(SCENE, NETWORK, range(N), SECONDS, compiled=compiled, **(arguments | options))


def are_equal(one: RolloutResult, other: RolloutResult) -> bool:
    metrics = all(one.metrics[name].tobytes() == other.metrics[name].tobytes() for name in METRICS)
    return metrics and bool((one.registers == other.registers).all() and (one.poses == other.poses).all())


@with_numba
def test_results_do_not_depend_on_threads_or_compilation() -> None:
    first = batch_of(True, threads=1)
    assert are_equal(first, batch_of(True, threads=2))
    assert are_equal(first, batch_of(True, threads=5))
    assert are_equal(first, batch_of(False))
    assert len(set(first.metrics["distance_m"].tolist())) == N


@pytest.mark.parametrize("compiled", KINDS)
def test_each_episode_of_a_batch_equals_a_single_episode(compiled: bool) -> None:
    results = batch_of(compiled, threads=2)
    setup = EpisodeSetup(SCENE)
    for index in (0, 3):
        episode = Episode(setup, NETWORK, compiled=compiled)
        options = EpisodeOptions(start=STARTS[index], vary=True, lamps=LAMPS[index], genes=GENES[index])
        episode.begin(index, options)
        episode.run(SECONDS)
        assert results.registers[index].tolist() == episode.registers.tolist()
        assert tuple(results.poses[index].tolist()) == episode.pose
        assert results.metrics["obstacle_avoidance"][index] == episode.metrics()["obstacle_avoidance"]


def drive_away(proximity: Any, ambient: Any, memory: Any, genes: Any) -> tuple[float, float]:
    return 10 - proximity[3] / 100, 10 - proximity[2] / 100


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
def test_a_policy_for_many_robots_drives_like_a_function_for_each(compiled: bool) -> None:
    def decide_all(proximity: Any, ambient: Any, which: Any) -> Any:
        assert proximity.shape == ambient.shape == (len(which), 8)
        return np.stack([10 - proximity[:, 3] / 100, 10 - proximity[:, 2] / 100], axis=1)

    options: dict[str, Any] = {"starts": STARTS, "compiled": compiled, "threads": 2}
    by_function = rollout(SCENE, Function(drive_away), range(N), SECONDS, **options)
    assert are_equal(by_function, rollout(SCENE, Policy(decide_all), range(N), SECONDS, **options))


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
def test_a_failed_episode_is_reported_by_seed_and_step_and_affects_no_other(compiled: bool) -> None:
    genes = np.array([[5.0, 1.0], [5.0, 0.0], [5.0, 2.0]])

    def divide(proximity: Any, ambient: Any, memory: Any, genes: Any) -> tuple[float, float]:
        memory[0] += 1
        return (float(genes[0]) / float(genes[1]) if memory[0] > 5 else 5.0), 5.0

    divides = Function(divide, n_memory=1)
    options: dict[str, Any] = {"compiled": compiled, "threads": 2}
    results = rollout(SCENE, divides, [11, 12, 13], 0.2, genes=genes, **options)
    (failure,) = results.failures
    assert (failure.index, failure.seed, failure.step) == (1, 12, 40)
    assert "no number" in failure.reason
    assert np.isnan(results.metrics["distance_m"]).tolist() == [False, True, False]
    others = rollout(SCENE, divides, [11, 13], 0.2, genes=genes[::2], **options)
    assert (results.registers[::2] == others.registers).all()


@pytest.mark.parametrize("compiled", KINDS)
def test_physics_that_fail_in_several_threads_affect_no_other_episode(
    compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class FailingEpisode(Episode):
        def begin(self, seed: int = 0, options: EpisodeOptions = DEFAULT_OPTIONS) -> None:
            super().begin(seed, options)
            if seed % 2:
                self.data.qvel[0] = np.nan if seed % 4 == 1 else 1e200

    monkeypatch.setattr(batch, "Episode", FailingEpisode)
    results = rollout(SCENE, Braitenberg(), range(12), 0.1, threads=4, compiled=compiled)
    assert [failure.seed for failure in results.failures] == [1, 3, 5, 7, 9, 11]
    assert {failure.step for failure in results.failures} == {4}  # the bounds are checked every tick
    others = rollout(SCENE, Braitenberg(), range(0, 12, 2), 0.1, compiled=compiled)
    assert (results.registers[::2] == others.registers).all()


def test_memory_does_not_grow_with_the_number_of_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    instances: list[Episode] = []

    class CountedEpisode(Episode):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            instances.append(self)

    monkeypatch.setattr(batch, "Episode", CountedEpisode)
    peaks = []
    for count in (10, 40):
        tracemalloc.start()
        rollout(SCENE, Braitenberg(), range(count), 0.02, compiled=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert len(instances) == 2
    assert peaks[1] - peaks[0] < 30 * 5000


def test_arguments_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="5 genes for 6 seeds; expected 6"):
        batch_of(False, genes=GENES[:5])
    with pytest.raises(ValueError, match="genes of shape"):
        batch_of(False, genes=np.full((N, 2), np.nan))
    with pytest.raises(ValueError, match=r"no genes for Network.*; expected shape \(6, "):
        batch_of(False, genes=None)
    with pytest.raises(ControllerError, match=r"2 genes for Network.*; expected "):
        batch_of(False, genes=np.zeros((N, 2)))
    with pytest.raises(ValueError, match=r"0.03 s; expected a whole number of control periods of 20 ms"):
        rollout(SCENE, Braitenberg(), [1], 0.03, compiled=False)
    with pytest.raises(ValueError, match=r"the policy returned speeds of shape \(2,\)"):
        rollout(SCENE, Policy(lambda proximity, ambient, which: np.zeros(2)), [1], 0.02, compiled=False)


@with_numba
def test_a_function_that_numba_cannot_compile_is_reported_by_name() -> None:
    def odd(proximity: Any, ambient: Any, memory: Any, genes: Any) -> tuple[float, float]:
        return open("x").fileno(), 0.0

    with pytest.raises(
        ControllerError, match=r"odd: numba cannot compile it: .*open.*; expected a function of"
    ):
        rollout(SCENE, Function(odd), [1], 0.02, compiled=True)


def read_beyond(proximity: Any, ambient: Any, memory: Any, genes: Any) -> tuple[float, float]:
    return memory[len(memory)], 1.0


@pytest.mark.share(2)
@with_numba
@pytest.mark.parametrize("njit", [False, True])
def test_a_function_that_reads_beyond_its_arrays_fails(njit: bool) -> None:
    decide = read_beyond
    if njit:
        import numba  # pyright: ignore[reportMissingTypeStubs]

        decide = numba.njit(read_beyond)  # pyright: ignore
    results = rollout(SCENE, Function(decide), range(2), 0.04, compiled=True)
    assert [failure.step for failure in results.failures] == [0, 0]
    assert results.failures[0].reason.endswith(
        "a controller gave a speed that is no number, or raised an error"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": [(60.0, 250.0)]}, r"starts\[0\] = \(60.0, 250.0\); expected x, y \[mm\] and heading"),
        ({"starts": [(60.0, math.nan, 0.0)]}, r"starts\[0\] = .*, 3 finite numbers"),
        ({"starts": ["60"]}, r"starts\[0\] = '60'; expected"),
        ({"lamps": [Lamp(x_mm=60, y_mm=60, power_w=1)]}, r"lamps\[0\] is one lamp"),
    ],
)
def test_arguments_of_episodes_are_checked_before_any_of_them_runs(options: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rollout(SCENE, Braitenberg(), [1], 0.02, compiled=False, **options)


@pytest.mark.parametrize(
    ("home", "message"),
    [
        ((60.0, 250.0, 50.0), "home = .*, 4 finite numbers"),
        ((60.0, 250.0, -50.0, 20.0), "home = .*; expected a radius and a charge above 0"),
    ],
)
def test_an_invalid_home_is_refused(home: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EpisodeOptions(home=home)


@pytest.mark.parametrize("seconds", [-1.0, math.nan, math.inf])
def test_an_invalid_duration_is_refused(seconds: float) -> None:
    with pytest.raises(ValueError, match="expected a time from 0"):
        rollout(SCENE, Braitenberg(), [1], seconds, compiled=False)


def test_an_invalid_driver_or_playpen_is_refused() -> None:
    with pytest.raises(
        ControllerError, match=r"is no controller; expected a ConstantSpeed, Braitenberg, Network"
    ):
        rollout(SCENE, drive_away, [1], 0.02, compiled=False)  # type: ignore[arg-type]
    with pytest.raises(PlaypenError, match=r"obstackles: no such file; .*did you mean 'obstacles'"):
        rollout("obstackles", Braitenberg(), [1], 0.02, compiled=False)
    with pytest.raises(PlaypenError, match=r"\['obstacles'\]: expected one playpen, its name or its path"):
        rollout(["obstacles"], Braitenberg(), [1], 0.02, compiled=False)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"the policy returned no speeds: .*expected an array \(1, 2\)"):
        rollout(SCENE, Policy(lambda *readings: [["a", "b"]]), [1], 0.02, compiled=False)


def test_common_options_apply_unless_an_episode_overrides_them() -> None:
    common = EpisodeOptions(start=STARTS[1], genes=GENES[1], noise=False)
    results = rollout(SCENE, NETWORK, [1, 2], 0.1, starts=STARTS[2:4], options=common, compiled=False)
    for row, seed in enumerate((1, 2)):
        episode = Episode(EpisodeSetup(SCENE), NETWORK, compiled=False)
        episode.begin(seed, replace(common, start=STARTS[2 + row]))
        episode.run(0.1)
        assert tuple(results.poses[row].tolist()) == episode.pose


def test_a_setup_needs_an_integer_step_and_no_faults_in_a_plane() -> None:
    with pytest.raises(ValueError, match="1 faults in the plane; expected none"):
        EpisodeSetup(SCENE, planar=True, faults=[parse_fault("blocked:left@1")])
    with pytest.raises(TypeError):
        EpisodeSetup(SCENE, step_ns=5e6)  # type: ignore[arg-type]


def test_constant_speeds_that_are_not_finite_fail() -> None:
    results = rollout(SCENE, ConstantSpeed(math.nan, 1), [1], 0.02, compiled=False)  # type: ignore[arg-type]
    assert results.failures[0].reason.endswith("was given the speeds nan, 1; expected finite numbers")


PAIR = """
[[robot]]
x_mm = 330
y_mm = 300
heading_deg = 90
"""


def test_results_of_several_robots_have_an_axis_of_robots_and_equal_those_of_episodes() -> None:
    setup = EpisodeSetup(playpen.parse(playpen.dump(Playpen.load("obstacles")) + PAIR, "pair"))
    genes = np.random.default_rng(2).normal(size=(3, 2, NETWORK.n_genes))
    results = rollout(setup, NETWORK, range(3), 0.4, genes=genes, compiled=False)
    assert results.poses.shape == (3, 2, 3)
    for index in range(3):
        episode = Episode(setup, NETWORK, compiled=False)
        episode.begin(index, EpisodeOptions(genes=genes[index]))
        episode.run(0.4)
        assert results.registers[index].tolist() == episode.boards.tolist()
        for robot in range(2):
            forward = results.metrics["forward_m"][index, robot]
            assert forward == episode.metrics(robot)["forward_m"]
    rows: list[tuple[int, ...]] = []

    def decide(proximity: Any, ambient: Any, episodes: Any) -> Any:
        rows.append(tuple(episodes.tolist()))
        return [(9, 9), (-4, 4)] * 3

    driven = rollout(setup, Policy(decide), range(3), 0.4, compiled=False)
    assert set(rows) == {(0, 0, 1, 1, 2, 2)}
    assert (driven.metrics["forward_m"][:, 0] > 0.02).all()
    assert (abs(driven.metrics["forward_m"][:, 1]) < 0.002).all()


@pytest.mark.parametrize("planar", [False, True])
def test_paths_contain_the_poses_at_even_times_and_change_no_result(planar: bool) -> None:
    setup = EpisodeSetup("obstacles", planar=planar)
    policy = Policy(lambda proximity, ambient, index: np.full((len(index), 2), (5.0, 4.0)))
    for driver in (ConstantSpeed(5, 4), policy):
        results = rollout(setup, driver, range(3), 0.6, paths_every=0.2, compiled=False)
        unsampled = rollout(setup, driver, range(3), 0.6, compiled=False)
        assert results.paths.shape == (3, 4, 3)
        assert unsampled.paths.shape == (3, 0, 3)
        assert np.array_equal(results.paths[:, -1], results.poses)
        assert np.array_equal(results.registers, unsampled.registers)
        assert results.metrics["distance_m"].tolist() == unsampled.metrics["distance_m"].tolist()
        first_part = rollout(setup, driver, range(3), 0.2, compiled=False)
        assert np.array_equal(results.paths[:, 1], first_part.poses)


def test_paths_of_several_robots_have_an_axis_of_robots_and_end_at_a_failure() -> None:
    robots = tuple(
        Playpen.load("default").robots[0].model_copy(update={"x_mm": x_mm}) for x_mm in (150.0, 400.0)
    )
    pair = Playpen.load("default").model_copy(update={"robots": robots})

    def policy(proximity: Any, ambient: Any, index: Any) -> Any:
        policy_calls.append(0)
        return np.full((len(index), 2), np.nan if len(policy_calls) > 2 else 1.0)

    policy_calls: list[int] = []
    results = rollout(pair, Policy(policy), [1], 0.08, paths_every=0.02, compiled=False)
    assert results.paths.shape == (1, 2, 5, 3)
    assert np.isfinite(results.paths[0, :, :3]).all()
    assert np.isnan(results.paths[0, :, 3:]).all()


@pytest.mark.parametrize("every", [0.0, 0.25, 0.05])
def test_a_sampling_period_must_divide_the_duration(every: float) -> None:
    with pytest.raises(ValueError, match=r"expected a (part|whole number)"):
        rollout("default", ConstantSpeed(1, 1), [1], 0.6, paths_every=every, compiled=False)


def test_a_policy_at_a_line_has_no_paths() -> None:
    policy = Policy(lambda proximity, ambient, index: np.zeros((len(index), 2)))
    with pytest.raises(ValueError, match=r"paths_every = 0\.2: a policy at a line decides at uneven times"):
        rollout("default", policy, [1], 0.6, line=38400, paths_every=0.2, compiled=False)


def test_final_registers_are_those_of_the_board_and_not_those_last_read_by_a_policy() -> None:
    setup, policy = (
        EpisodeSetup("obstacles", planar=True, at_line=True),
        Policy(lambda p, a, which: 0 * p[:, :2] + 9),
    )
    results = rollout(setup, policy, [1], 0.5, line=9600, compiled=False)
    episode = Episode(setup, policy, compiled=False)
    episode.begin(1, EpisodeOptions(line=9600))
    end_step = setup.periods(0.5) * setup.steps_per_period
    episode.next_reading(end_step)
    while episode.steps < end_step:
        episode.drive(9, 9)
        episode.next_reading(end_step)
    assert results.registers[0].tolist() == episode.registers.tolist()
    assert results.registers[0, PROXIMITY].tolist() != episode.readings()[0]


def test_an_episode_that_fails_to_start_has_separate_registers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "BATCH_SIZE", 1)
    setup, policy = EpisodeSetup("obstacles", planar=True), Policy(lambda p, a, which: 0 * p[:, :2] + 9)
    starts = [(200.0, 200.0, 0.0), (1e9, 0.0, 0.0)]
    results = rollout(setup, policy, [1, 2], 0.5, starts=starts, compiled=False)
    assert [failure.index for failure in results.failures] == [1]
    assert (results.registers[:, Wheel.POSITION] != 0).tolist() == [True, False]
