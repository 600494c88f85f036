"""Readings of lamps: the model against the sampled robot and against a scene, and its fit."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scenes import arena, robot, table

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT
from khep_twin.errors import FitError
from khep_twin.lab.fit import lamp_fit
from khep_twin.lab.fit.lamp_fit import LampPositions, ambient_counts, fit_lamps
from khep_twin.lab.fit.least_squares import Parameter
from khep_twin.lab.fit.placement import IN_PLACE, Misplacement, Readings, Ruler, SensorsFit
from khep_twin.sensing import calibration
from khep_twin.units import SENSOR_HEIGHT, SENSOR_POSITIONS
from khep_twin.world import World
from studies.lamp_fits import FAR, SET_UP_BEARING, readings, residuals, sampled_lamp

KHEPERA1 = calibration.read("khepera1")[0]
SENSORS = range(8)

# Derived from the samples of the real robot with a lamp of 2 W: bearing of the lamp, counter-clockwise and
# with the set-up's error, at which a receiver sees it best, and width above half of its depth [deg], both at
# 213 mm; within 10 degrees of that bearing, distance at which it reads 250 [mm], and reading at 213 mm.
BEST_DEG = [99.7, 51.0, 11.7, 0.4, -44.8, -79.4, -172.2, -177.0]
WIDTH_DEG = [92, 88, 98, 102, 98, 94, 88, 96]
AT_250_MM = [120.1, 131.9, 130.8, 129.6, 130.9, 127.6, 130.5, 131.4]
AT_213_COUNTS = [397, 383, 388, 391, 383, 394, 385, 382]
BEARINGS = -np.radians(np.arange(0, 360, 2))
DISTANCES = np.arange(0.073, 0.534, 0.02)


def turned(distance: float, power: float = 2.0) -> Readings:
    """Poses of a robot that turns in a lamp's light, without readings."""
    return readings(np.full(180, distance), SET_UP_BEARING + BEARINGS, np.zeros((180, 8)), power)


def lamp(distance: float) -> LampPositions:
    return LampPositions.of(turned(distance))


@pytest.mark.parametrize("sensor", SENSORS)
def test_each_receiver_has_the_derived_figures_of_the_real_one(sensor: int) -> None:
    dark = KHEPERA1.ambient.dark_counts
    depths = dark - ambient_counts(lamp(0.213), sensor, KHEPERA1.ambient)
    best = np.angle((depths * np.exp(1j * BEARINGS)).sum(), deg=True)
    assert (best - BEST_DEG[sensor] + 180) % 360 - 180 == pytest.approx(0, abs=5)
    assert 2 * (depths > depths.max() / 2).sum() == pytest.approx(WIDTH_DEG[sensor], abs=18)
    near = np.abs(np.angle(np.exp(1j * (BEARINGS - np.radians(BEST_DEG[sensor]))))) <= np.radians(10)
    means = [ambient_counts(lamp(distance), sensor, KHEPERA1.ambient)[near].mean() for distance in DISTANCES]
    assert np.interp(250, means, DISTANCES) * 1e3 == pytest.approx(AT_250_MM[sensor], abs=8)
    assert np.interp(0.213, DISTANCES, means) == pytest.approx(AT_213_COUNTS[sensor], abs=9)


def test_the_sampled_lamp_is_met_far_off_and_near(reference: Path) -> None:
    distances, test = sampled_lamp(reference)
    errors = residuals(test, KHEPERA1.ambient)
    far = distances >= FAR
    assert np.sqrt(np.mean(errors[far] ** 2)) <= 15
    assert np.sqrt(np.mean(errors[~far] ** 2)) <= 68.5


def read_in_scene(forward: float, left: float, height: float) -> np.ndarray:
    x_mm, y_mm, z_mm = 1000 + forward * 1e3, 1000 + left * 1e3, (height + SENSOR_HEIGHT) * 1e3
    text = arena(2000, 2000) + robot(1000, 1000) + table("lamp", x_mm=x_mm, y_mm=y_mm, z_mm=z_mm, power_w=2)
    return World(playpen.parse(text, "lamp"), noise=False).robots[0].registers[AMBIENT]


@pytest.mark.parametrize(
    "position", [(0.2, 0.0, 0.0016), (0.1, 0.15, 0.05), (-0.07, 0.02, 0.03), (0.0, -0.5, 0.2)]
)
def test_the_law_for_many_positions_gives_what_the_scene_gives(position: tuple[float, float, float]) -> None:
    table = LampPositions(np.array([position]), 2.0, SENSOR_POSITIONS)
    expected = [ambient_counts(table, sensor, KHEPERA1.ambient)[0] for sensor in SENSORS]
    # The wheels may hide a lamp behind the robot from a sensor that sees it only by its diffuse part.
    np.testing.assert_allclose(read_in_scene(*position), expected, atol=1.5)


HIDDEN = KHEPERA1.ambient.model_copy(
    update={
        "gain_counts_mm2_per_w": (2.9e6, 2.2e6, 2.5e6, 3.1e6, 2.4e6, 2.8e6, 2.3e6, 3.0e6),
        "heading_deg": (90.0, 50.0, 8.0, -9.0, -48.0, -91.0, 176.0, -177.0),
        "lobe_exponent": (2.0, 1.8, 1.5, 2.2, 2.4, 2.6, 1.9, 2.1),
        "dark_counts": 470.0,
        "floor_counts": 90.0,
        "diffuse": 0.1,
    }
)


def recorded(*distances: float, seed: int = 1, moved: Misplacement = IN_PLACE) -> list[Readings]:
    """A hidden robot's noisy readings in full turns, of misplaced lamps."""
    rng = np.random.default_rng(seed)
    tests: list[Readings] = []
    for distance in distances:
        test = turned(distance)
        for sensor in SENSORS:
            test.counts[:, sensor] = np.round(
                ambient_counts(LampPositions.of(test, moved), sensor, HIDDEN)
                + 5 * rng.standard_normal(len(BEARINGS))
            )
        tests.append(test)
    return tests


def intervals(fit: SensorsFit, key: str) -> np.ndarray:
    """Intervals of a parameter of all receivers."""
    return np.array([value.interval for value in fit.values if value.path[1] == key])


def test_hidden_receivers_are_found_from_two_turns() -> None:
    fit = fit_lamps(recorded(0.07, 0.15), KHEPERA1)
    ambient = fit.calibration.ambient
    np.testing.assert_allclose(ambient.gain_counts_mm2_per_w, HIDDEN.gain_counts_mm2_per_w, rtol=0.03)
    differences = np.array(ambient.heading_deg) - HIDDEN.heading_deg
    np.testing.assert_allclose((differences + 180) % 360 - 180, 0, atol=1.5)
    np.testing.assert_allclose(ambient.lobe_exponent, HIDDEN.lobe_exponent, atol=0.2)
    assert ambient.dark_counts == pytest.approx(470, abs=1)
    assert ambient.floor_counts == pytest.approx(90, abs=1)
    assert ambient.diffuse == pytest.approx(0.1, abs=0.02)
    assert fit.rms[0] == pytest.approx(5, abs=0.5)
    assert max(intervals(fit, "gain_counts_mm2_per_w") / ambient.gain_counts_mm2_per_w) < 0.04


@pytest.mark.parametrize(("distances", "is_fitted"), [((0.07, 0.15), True), ((0.15, 0.25), False)])
def test_the_level_of_the_brightest_light_is_fitted_only_to_saturated_readings(
    distances: tuple[float, ...], is_fitted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    names: list[str] = []

    def note_names(_: object, parameters: Sequence[Parameter], *__: object, **___: object) -> None:
        names.extend(parameter.name for parameter in parameters)
        raise FitError("noted")

    monkeypatch.setattr(lamp_fit, "least_squares", note_names)
    with pytest.raises(FitError, match="noted"):
        fit_lamps(recorded(*distances), KHEPERA1)
    assert ("level of the brightest light" in names) == is_fitted


def test_readings_in_the_dark_are_refused_by_receiver() -> None:
    with pytest.raises(FitError, match="left 90: the gain for lamps cannot be determined"):
        fit_lamps([readings(np.full(180, 0.15), BEARINGS, np.full((180, 8), 470.0), 2.0)], KHEPERA1)


def test_the_intervals_contain_what_a_ruler_s_error_does() -> None:
    moved = Misplacement(0.0005, math.radians(1.5))
    fit = fit_lamps(recorded(0.07, 0.15, moved=moved), KHEPERA1)
    ambient = fit.calibration.ambient
    gains = np.array(ambient.gain_counts_mm2_per_w) / HIDDEN.gain_counts_mm2_per_w
    gain_intervals = intervals(fit, "gain_counts_mm2_per_w") / ambient.gain_counts_mm2_per_w
    assert (np.abs(gains - 1) < 1.3 * gain_intervals).all()
    headings = (np.array(ambient.heading_deg) - HIDDEN.heading_deg + 180) % 360 - 180
    assert (np.abs(headings) < 1.3 * intervals(fit, "heading_deg")).all()
    exact = fit_lamps(recorded(0.07, 0.15), KHEPERA1, Ruler(0, 0, 0))
    assert min(intervals(fit, "heading_deg")) > 2 * max(intervals(exact, "heading_deg"))


def test_a_lamp_that_was_only_passed_on_one_side_does_not_tell_the_other_sensors() -> None:
    (full_turn,) = recorded(0.15)
    is_ahead = np.abs(np.angle(np.exp(1j * BEARINGS))) < 0.6
    with pytest.raises(FitError, match=r"^(back right|left 90|right 90|back left)"):
        fit_lamps(
            [readings(np.full(is_ahead.sum(), 0.15), BEARINGS[is_ahead], full_turn.counts[is_ahead], 2.0)],
            KHEPERA1,
        )
