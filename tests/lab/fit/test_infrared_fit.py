"""Sensors from readings: gains that a twin was made with are found, and data that cannot tell is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.files.toml_files import dump
from khep_twin.host import Khepera
from khep_twin.lab.fit.infrared import TANGENTS, MeasuredTable, Optics, proximity
from khep_twin.lab.fit.infrared_fit import expected, fit_infrared, fitted
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing import calibration
from khep_twin.units import BODY_RADIUS, PULSE_LENGTH, WHEEL_BASE

KHEPERA1 = calibration.read("khepera1")[0]
FACTORS = np.array([1.2, 0.85, 0.9, 1.1, 1.0, 1.15, 0.8, 0.95])


def hidden_calibration() -> calibration.Calibration:
    gains = tuple(float(gain) for gain in np.array(KHEPERA1.proximity.gain_counts_mm2) * FACTORS)
    thresholds = tuple(float(each) for each in np.array(KHEPERA1.proximity.threshold_counts) + 40)
    update = {"gain_counts_mm2": gains, "threshold_counts": thresholds}
    return KHEPERA1.model_copy(update={"proximity": KHEPERA1.proximity.model_copy(update=update)})


def turn(path: str, distance_mm: float, seed: int) -> tuple[MeasuredTable, float]:
    """A robot turns slowly once in front of a wall, by its own counters; its readings and its time [s]."""
    x_mm = 1000 - BODY_RADIUS * 1000 - distance_mm
    text = (
        'version = 1\nname = "bench"\n[arena]\nwidth_mm = 1000\nheight_mm = 1000\n[[robot]]\n'
        f'x_mm = {x_mm}\ny_mm = 500\nheading_deg = 0\ncalibration = "{path}"\n'
    )
    bearings: list[float] = []
    counts: list[tuple[int, ...]] = []
    twin = open_twin(playpen.parse(text, "bench"), TwinOptions(seed=seed))
    with Khepera(Serial.of(twin, timeout=1.0)) as robot:
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
    n = len(counts)
    return MeasuredTable(
        np.full(n, distance_mm / 1e3), np.array(bearings), np.array(counts, np.float64), 0.0
    ), time


def test_hidden_gains_are_found_within_three_minutes_of_robot_time(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    path = tmp_path_factory.mktemp("hidden") / "hidden.toml"
    path.write_text(dump(hidden_calibration()))
    turns = [turn(str(path), distance_mm, seed) for seed, distance_mm in enumerate((14, 18, 22, 26, 30))]
    assert sum(time for _, time in turns) < 180
    fits = fit_infrared([table for table, _ in turns], KHEPERA1)
    found = fitted(KHEPERA1, fits).proximity
    gains = np.array(found.gain_counts_mm2) / hidden_calibration().proximity.gain_counts_mm2
    np.testing.assert_allclose(gains, 1, atol=0.03)
    assert max(fit.gain_interval for fit in fits) < 0.05
    # Most readings are cut off at 0, where noise of 22 counts hardly shows.
    assert all(5 < fit.rms < 14 for fit in fits)


def bench(distances_mm: list[float], factor: float = 1.0) -> MeasuredTable:
    """Quiet readings of a robot with other gains, worked out."""
    bearings = np.radians(np.arange(-180, 180, 4.0))
    distances = np.repeat(distances_mm, len(bearings)) / 1e3
    table = MeasuredTable(distances, np.tile(bearings, len(distances_mm)), np.zeros((len(distances), 8)), 0.0)
    for sensor in range(8):
        optics = Optics.of(KHEPERA1.proximity, sensor)
        view = table.view(sensor, math.radians(KHEPERA1.heading_deg[sensor]))
        table.counts[:, sensor] = proximity(
            view, TANGENTS, replace(optics, gain_counts_mm2=optics.gain_counts_mm2 * factor)
        )
    return table


def test_without_noise_the_gains_are_exact() -> None:
    quiet = KHEPERA1.model_copy(
        update={"proximity": KHEPERA1.proximity.model_copy(update={"noise_counts": 0.0})}
    )
    fits = fit_infrared([bench([15, 20, 25], 1.3)], quiet)
    for sensor, fit in enumerate(fits):
        assert fit.optics.gain_counts_mm2 == pytest.approx(
            1.3 * KHEPERA1.proximity.gain_counts_mm2[sensor], rel=1e-3
        )
        assert fit.rms < 1


@pytest.mark.parametrize("distances_mm", [[4.0], [200.0]])
def test_readings_that_are_all_saturated_or_0_are_refused_by_sensor(distances_mm: list[float]) -> None:
    table = bench(distances_mm)
    ahead = np.abs(table.bearings) < 0.3
    with pytest.raises(FitError, match=r"left 90: the gain cannot be determined: \d+ readings"):
        fit_infrared(
            [MeasuredTable(table.distances[ahead], table.bearings[ahead], table.counts[ahead], 0.0)], KHEPERA1
        )


def test_the_mean_of_noisy_readings_that_are_cut_off() -> None:
    levels = np.array([-500.0, -20.0, 0.0, 30.0, 500.0, 1000.0, 1023.0, 2000.0])
    noisy = levels + 40 * np.random.default_rng(1).standard_normal((400_000, 1))
    np.testing.assert_allclose(expected(levels, 40, 1023), np.clip(noisy, 0, 1023).mean(axis=0), atol=0.3)
