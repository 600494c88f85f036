"""The benchmark of behaviour: a small synthetic table is read, moved in and compared as a real one is."""

import math

import numpy as np
import pytest

from khep_twin.board import kernel
from khep_twin.units import BODY_RADIUS, COUNTS_LIMIT, SENSOR_HEADINGS
from studies import behaviour
from studies.behaviour import judge, pooled, text
from studies.behaviour_controllers import avoider, networks, threshold_stop
from studies.behaviour_trials import Trial, heading_for, stopping_difference, trials, turning_difference
from studies.one_object import CYLINDER, LAMP, PERIOD_S, WALL, Controller, Target, TwinWorld, run
from studies.sampled_world import Kinematics, SampledWorld, Samples, along_axes, table_readings

BEARINGS = np.radians(np.arange(-180, 180, 4))
DISTANCES = np.arange(5, 46, 4) / 1000


def level(distances: np.ndarray, bearings: np.ndarray) -> np.ndarray:
    """Made-up sensors: a parabola over the distance, a lobe around the heading of each."""
    lobe = (1 + np.cos(bearings[:, None] - SENSOR_HEADINGS)) / 2
    return COUNTS_LIMIT * ((0.045 - distances[:, None]) / 0.04) ** 2 * lobe**3


def synthetic(noise: float = 0.0) -> Samples:
    distances, bearings = (grid.ravel() for grid in np.meshgrid(DISTANCES, BEARINGS, indexing="ij"))
    rng = np.random.default_rng(0)
    counts = level(distances, bearings) + noise * rng.standard_normal((len(distances), 8))
    order = rng.permutation(len(counts))
    return Samples(distances[order], bearings[order], np.clip(counts[order], 0, COUNTS_LIMIT))


FORWARD = Controller("forward", lambda proximity, ambient, memory: np.full((len(proximity), 2), 5.0))


def world(target: Target, noise_seed: int | None = None, noise: float = 0.0) -> SampledWorld:
    return SampledWorld(target, table_readings(target, synthetic(noise), noise_seed), Kinematics())


def test_a_table_is_read_at_and_between_its_samples_in_whatever_order_they_come() -> None:
    table, rng = synthetic(), np.random.default_rng(1)
    distances, bearings = rng.uniform(0.014, 0.04, 50), rng.uniform(-7, 7, 50)
    np.testing.assert_allclose(table.read(distances, bearings), level(distances, bearings), atol=8)
    np.testing.assert_allclose(
        table.nearest(np.array([0.0131]), np.array([0.01])), level(np.array([0.013]), np.array([0.0]))
    )


def test_beyond_a_table_nothing_is_read_and_before_it_the_first_row() -> None:
    table, pose = synthetic(), np.zeros(3)
    counts = table.read(np.array([0.001, 0.005, 0.2]), pose)
    assert counts[0].tolist() == counts[1].tolist()
    assert counts[2].max() == pytest.approx(0, abs=1)
    assert table.nearest(np.array([0.2]), np.zeros(1)).max() == pytest.approx(0, abs=1)


def test_a_table_is_smoothed_and_its_noise_drawn_again_is_as_large() -> None:
    table = synthetic(noise=30)
    distances, bearings = np.full(4000, 0.025), np.zeros(4000)
    quiet = table.read(distances[:1], bearings[:1])[0, 2]
    assert quiet == pytest.approx(level(distances[:1], bearings[:1])[0, 2], abs=25)
    drawn = table.read(distances, bearings, np.random.default_rng(2))[:, 2]
    assert drawn.mean() == pytest.approx(quiet, abs=15)
    assert drawn.std() == pytest.approx(30, rel=0.4)


@pytest.mark.parametrize("target", [WALL, CYLINDER, LAMP], ids=lambda target: target.name)
def test_starts_are_as_far_off_and_as_far_aside_as_wanted(target: Target) -> None:
    distances, bearings = target.place(heading_for(target, 40, np.array([-30, 0, 150])))
    np.testing.assert_allclose(distances, 0.04)
    np.testing.assert_allclose(np.degrees(bearings), [30, 0, -150])


def test_kinematics_drive_the_arcs_of_their_table() -> None:
    speeds = np.array([[left, right] for left in range(-3, 4) for right in range(-3, 4)], np.float64)
    way, turn = 0.041 * speeds.sum(axis=1), 0.87 * (speeds[:, 0] - speeds[:, 1])
    motion = Kinematics.of_table(np.column_stack([speeds, turn, way]))
    assert motion.speed == pytest.approx(8.2e-3)
    assert motion.base == pytest.approx(0.054, abs=1e-4)
    # A quarter turn to the left around a centre at radius r ends r ahead and r to the left.
    ratio = (1 - motion.base / 2 / 0.2) / (1 + motion.base / 2 / 0.2)
    seconds = math.pi / 2 * (0.2 + motion.base / 2) / motion.speed
    end = motion.move(np.zeros((1, 3)), np.array([[ratio, 1.0]]), seconds)
    np.testing.assert_allclose(end, [[0.2, 0.2, math.pi / 2]])


def test_a_robot_stops_where_the_table_has_the_threshold() -> None:
    starts = heading_for(WALL, 60, np.array([0.0]))
    track = run(world(WALL), WALL, threshold_stop(400), starts, 4.0)
    at = DISTANCES[0] + 1e-3 * np.arange(400) / 10
    reads = level(at, np.zeros(len(at))).max(axis=1)
    expected = at[np.flatnonzero(reads >= 400)[-1]]
    assert track.gaps[-1, 0] == pytest.approx(expected, abs=1e-3)
    assert (np.diff(track.gaps[:, 0]) <= 1e-12).all()


def test_a_wall_stops_a_robot_and_a_lamp_does_not() -> None:
    starts = heading_for(WALL, 20, np.array([20.0]))
    assert run(world(WALL), WALL, FORWARD, starts, 2.0).gaps[-1, 0] == pytest.approx(0, abs=1e-9)
    assert run(world(LAMP), LAMP, FORWARD, heading_for(LAMP, 20, np.zeros(1)), 2.0).gaps.min() < -0.02


def test_a_curve_along_the_axes_sees_what_they_meet() -> None:
    wall_axes = along_axes(WALL, lambda lengths: 1000 - lengths * 1e4)
    (proximity,), (ambient,) = wall_axes(np.array([0.02]), np.array([0.0]))
    away = 0.02 + BODY_RADIUS - 0.025
    assert proximity[2] == pytest.approx(1000 - 1e4 * away / math.cos(SENSOR_HEADINGS[2]))
    assert proximity[[0, 5, 6, 7]].max() < 1
    assert ambient.min() == ambient.max() > 0
    cylinder_axes = along_axes(CYLINDER, lambda lengths: 1000 - lengths * 1e4)
    (proximity,), _ = cylinder_axes(np.array([0.02]), np.array([math.radians(45)]))
    # The sensor is 0.5 mm off the line from the robot's centre to the cylinder's.
    assert proximity[1] == pytest.approx(1000 - 1e4 * (0.0475 - math.hypot(0.019, 0.017)), abs=4)
    assert np.flatnonzero(proximity).tolist() == [1]


def test_controllers_are_the_twins_own() -> None:
    counts = np.random.default_rng(4).integers(0, 1024, (30, 8))
    board = [0] * kernel.N_REGISTERS
    for row, speeds in zip(counts, avoider().decide(counts, counts, np.zeros((30, 0))), strict=True):
        board[kernel.PROXIMITY[0] : kernel.PROXIMITY[0] + 8] = row.tolist()
        kernel.wander(board)
        assert [board[setpoint] for setpoint in kernel.SETPOINTS] == speeds.tolist()


def test_networks_depend_on_their_seed_and_remember() -> None:
    first, second = networks(2)
    dark, memory = np.full((3, 8), 485.0), np.zeros((3, first.n_memory))
    counts = np.full((3, 8), 500.0)
    before = first.decide(counts, dark, memory)
    assert memory.any()
    assert not np.array_equal(before, first.decide(counts, dark, memory))
    assert not np.array_equal(before, second.decide(counts, dark, np.zeros_like(memory)))
    assert np.array_equal(before, networks(1)[0].decide(counts, dark, np.zeros_like(memory)))


def test_twin_and_table_are_compared_beside_a_floor_the_same_each_time() -> None:
    samples, stop = {WALL: synthetic(30)}, {"stopping distance [mm]": stopping_difference}
    heading_ahead = heading_for(WALL, 40, np.array([-20.0, 0.0]))
    chosen = [
        Trial(WALL, threshold_stop(400), heading_ahead, 1.2, stop),
        Trial(WALL, threshold_stop(300), heading_ahead, 1.2, {**stop, "turn [deg]": turning_difference}),
    ]
    rows = judge(samples, Kinematics(), chosen, seed=3)
    assert [(row.measure, row.controller, row.count) for row in rows] == [
        ("stopping distance [mm]", "stop at 400", 2),
        ("stopping distance [mm]", "stop at 300", 2),
        ("turn [deg]", "stop at 300", 2),
    ]
    assert rows == judge(samples, Kinematics(), chosen, seed=3)
    for row in rows[:2]:
        # The twin with the table's readings differs by its motors and the age of nothing else.
        assert abs(row.motion[1]) < 1.5
        assert 0 < row.floor[0] < 10
        assert row.peers.keys() == {behaviour.EVOROBOT, *behaviour.PEERS}
    together = pooled(rows)
    assert [(row.controller, row.count) for row in together] == [("2 vehicles", 4), ("stop at 300", 2)]
    squares = [row.quiet[0] ** 2 for row in rows[:2]]
    assert together[0].quiet[0] == pytest.approx(math.sqrt(sum(squares) / 2))
    assert abs(together[0].quiet[1]) == max(abs(row.quiet[1]) for row in rows[:2])
    assert len(text(rows).splitlines()) == 1 + len(rows)


def test_every_trial_has_starts_outside_its_object_and_whole_periods() -> None:
    for trial in trials():
        assert trial.target.place(trial.starts)[0].min() > 0
        assert trial.seconds / PERIOD_S == pytest.approx(round(trial.seconds / PERIOD_S))
        assert trial.measures


def test_the_twins_world_has_the_object_where_the_table_has_it() -> None:
    for target in (WALL, CYLINDER):
        twin = TwinWorld(target)
        twin.begin(heading_for(target, 8, np.array([0.0, 90.0])))
        (front, aside), ambient = twin.read()
        assert front[2] > 900
        assert aside[5] > 700  # on its right
        assert ambient.min() > 450
    twin = TwinWorld(LAMP)
    twin.begin(heading_for(LAMP, 150, np.array([90.0])))
    _, (ambient,) = twin.read()
    assert ambient.argmin() == 5
