"""Fit of sensors: a hidden twin's gains are recovered, and data that do not determine them are refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import arena, hosted

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.lab.fit.infrared_fit import fit_infrared, mean_counts
from khep_twin.lab.fit.least_squares import expected_readings
from khep_twin.lab.fit.placement import IN_PLACE, Misplacement, Placement, Readings, Ruler, SensorsFit
from khep_twin.sensing import calibration
from khep_twin.units import BODY_RADIUS, PULSE_LENGTH, WHEEL_BASE

KHEPERA1 = calibration.read("khepera1")[0]
FACTORS = np.array([1.2, 0.85, 0.9, 1.1, 1.0, 1.15, 0.8, 0.95])


def hidden_calibration() -> calibration.Calibration:
    gains = tuple(float(gain) for gain in np.array(KHEPERA1.proximity.gain_counts_mm2) * FACTORS)
    thresholds = tuple(float(counts) for counts in np.array(KHEPERA1.proximity.threshold_counts) + 40)
    update = {"gain_counts_mm2": gains, "threshold_counts": thresholds}
    return KHEPERA1.model_copy(update={"proximity": KHEPERA1.proximity.model_copy(update=update)})


def turn(path: str, distance_mm: float, seed: int) -> tuple[Readings, float]:
    """A robot turns slowly once in front of a wall, by its counters; its readings and its time [s]."""
    x_mm = 1000 - BODY_RADIUS * 1000 - distance_mm
    text = arena(1000, 1000) + scenes.robot(x_mm, 500, calibration=path)
    bearings: list[float] = []
    counts: list[tuple[int, ...]] = []
    with hosted(playpen.parse(text, "bench"), seed=seed) as robot:
        robot.set_position(0, 0)
        robot.set_speed(-2, 2)
        turned = 0.0
        while turned < 2 * math.pi:
            left, right = robot.position()
            reading = robot.proximity()
            after_left, after_right = robot.position()
            turned = (after_right - after_left) * PULSE_LENGTH / WHEEL_BASE
            before = (right - left) * PULSE_LENGTH / WHEEL_BASE
            bearings.append(-(before + turned) / 2)
            counts.append(reading)
        robot.set_speed(0, 0)
        time = robot.time
    return readings(distance_mm, np.array(bearings), np.array(counts, np.float64)), time


def readings(distance_mm: float, bearings: np.ndarray, counts: np.ndarray) -> Readings:
    """Readings of a robot that turns on the spot in front of a wall."""
    poses = np.column_stack([np.zeros((len(bearings), 2)), -bearings])
    return Readings(f"{distance_mm} mm", Placement(poses, distance_mm / 1e3), counts)


def intervals(infrared: SensorsFit, key: str) -> np.ndarray:
    """Intervals of a parameter of all sensors that determine it."""
    return np.array([value.interval for value in infrared.values if value.path[1] == key])


def gains_of(infrared: SensorsFit) -> np.ndarray:
    """Fitted gains of all sensors."""
    return np.array([value.value for value in infrared.values if value.path[1] == "gain_counts_mm2"])


@pytest.mark.long
def test_hidden_gains_are_found_within_three_minutes_of_robot_time(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("hidden") / "hidden.toml"
    path.write_text(dump(hidden_calibration()))
    turns = [turn(str(path), distance_mm, seed) for seed, distance_mm in enumerate((14, 18, 22, 26, 30))]
    assert sum(time for _, time in turns) < 180
    infrared = fit_infrared([test for test, _ in turns], KHEPERA1)
    gains = (
        np.array(infrared.calibration.proximity.gain_counts_mm2)
        / hidden_calibration().proximity.gain_counts_mm2
    )
    np.testing.assert_allclose(gains, 1, atol=0.03)
    assert max(intervals(infrared, "gain_counts_mm2") / gains_of(infrared)) < 0.07
    # Most readings are clipped to 0, so that noise of 22 counts is hardly visible.
    assert all(5 < rms < 14 for rms in infrared.rms)


def bench(distances_mm: list[float], moved: Misplacement = IN_PLACE) -> list[Readings]:
    """Computed readings of the hidden robot without noise, in front of misplaced walls."""
    bearings = np.radians(np.arange(-180, 180, 4.0))
    tests = [readings(distance_mm, bearings, np.empty(0)) for distance_mm in distances_mm]
    counts = [np.clip(mean_counts(test.placement, hidden_calibration(), moved), 0, 1023) for test in tests]
    return [replace(test, counts=readings) for test, readings in zip(tests, counts, strict=True)]


QUIET = KHEPERA1.model_copy(update={"proximity": KHEPERA1.proximity.model_copy(update={"noise_counts": 0.0})})


def test_without_noise_and_with_an_exact_ruler_the_gains_are_exact() -> None:
    infrared = fit_infrared(bench([15, 20, 25]), QUIET, Ruler(0, 0, 0))
    np.testing.assert_allclose(gains_of(infrared), hidden_calibration().proximity.gain_counts_mm2, rtol=1e-2)
    assert max(infrared.rms) < 1


@pytest.mark.long
def test_a_wall_that_stood_elsewhere_is_found_there_as_far_as_the_others_tell() -> None:
    tests = bench([15, 20, 25, 30])
    (wrong,) = bench([22], Misplacement(0.002, math.radians(4)))
    moved = fit_infrared([*tests, wrong], QUIET).misplacements
    # An error common to all tests is equivalent to a distance and heading of the robot.
    assert moved[-1].distance - moved[0].distance == pytest.approx(0.002, abs=0.0003)
    assert moved[-1].bearing - moved[0].bearing == pytest.approx(math.radians(4), abs=math.radians(0.4))


@pytest.mark.long
def test_a_ruler_widens_the_intervals_by_what_its_error_does() -> None:
    tests = bench([12, 17, 21, 25, 29])
    exact, usual = (fit_infrared(tests, KHEPERA1, Ruler(mm, deg, 0)) for mm, deg in ((0, 0), (0.5, 1.5)))
    narrow, wide = (intervals(fit, "gain_counts_mm2") / gains_of(fit) for fit in (exact, usual))
    assert (wide > 1.15 * narrow).all()
    # About the mean of five bearings, each with an error of 1.5 degrees.
    ratios = intervals(usual, "heading_deg") / (1.96 * 1.5 / math.sqrt(5))
    assert len(ratios) == 8
    assert ((ratios > 0.5) & (ratios < 2.5)).all()


@pytest.mark.parametrize("distances_mm", [[4.0], [200.0]])
def test_readings_that_are_all_saturated_or_0_are_refused_by_sensor(distances_mm: list[float]) -> None:
    (test,) = bench(distances_mm)
    is_ahead = np.abs(test.placement.poses[:, 2]) < 0.3
    part = readings(distances_mm[0], -test.placement.poses[is_ahead, 2], test.counts[is_ahead])
    with pytest.raises(FitError, match=r"left 90: the gain cannot be determined: \d+ readings"):
        fit_infrared([part], KHEPERA1)


def test_the_mean_of_noisy_readings_that_are_cut_off() -> None:
    levels = np.array([-500.0, -20.0, 0.0, 30.0, 500.0, 1000.0, 1023.0, 2000.0])
    noisy = levels + 40 * np.random.default_rng(1).standard_normal((400_000, 1))
    np.testing.assert_allclose(
        expected_readings(levels, 40, 1023), np.clip(noisy, 0, 1023).mean(axis=0), atol=0.3
    )
