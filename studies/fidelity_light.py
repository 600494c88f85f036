"""Comparisons of ambient light: the sampled lamp, and the figures of both manuals."""

import math
from functools import cache
from pathlib import Path

import numpy as np

from khep_twin.lab.fit.lamp_fit import LampPositions
from khep_twin.playpen import Arena, Lamp, Playpen, RobotEntry
from khep_twin.sensing import calibration
from khep_twin.units import BODY_HEIGHT, N_SENSORS, SENSOR_HEADINGS, SENSOR_HEIGHT, SENSOR_POSITIONS
from studies.fidelity_comparison import Comparison, Floats, Outcome, columns, noise_variance, read_at_rest
from studies.infrared_fits import rms
from studies.lamp_fits import COUNTS_AT_0, FAR, FILAMENT_HEIGHT, POWER, SAMPLED_LIMIT, sampled_lamp

_SAMPLED = "one Khepera, sampled at CNR Rome, lamp of about 2 W"
_MIDDLE_MM = 1500.0
_FRONT_SENSORS = range(6)
_FIGURE_10_MM = 300.0
"""Distance of the lamp of the manual's figure 10 (assumed; the depth of each receiver is fitted)."""


def lamp_counts(robot: RobotEntry, power: float, positions: Floats, height: float) -> Floats:
    """Return the twin's ambient counts (n, 8) with a lamp at positions, forward and left of the robot [m].

    Args:
        robot: Robot, whose pose is ignored.
        power: Power [W].
        positions: Positions (n, 2) [m].
        height: Height above the floor [m].
    """
    lamp = Lamp(x_mm=_MIDDLE_MM, y_mm=_MIDDLE_MM, z_mm=height * 1e3, power_w=power)
    arena = Arena(width_mm=2 * _MIDDLE_MM, height_mm=2 * _MIDDLE_MM)
    scene = Playpen(version=1, name="bench", arena=arena, robot=(robot,), lamp=(lamp,), surfaces={})
    return read_at_rest(scene, np.column_stack([_MIDDLE_MM - positions * 1e3, np.zeros(len(positions))]))[1]


@cache
def sampled_errors(folder: Path) -> tuple[Floats, Floats, Floats, Floats]:
    """Return distances (n,) [m], and errors of the twin and of Michel's simulator (n, 8) and noise (8,).

    All but the distances are on the samples' scale of 1023.
    """
    distances, table = sampled_lamp(folder)
    positions = LampPositions.of(table).positions[:, :2]
    scale = SAMPLED_LIMIT / COUNTS_AT_0
    modelled = lamp_counts(_robot("khepera1"), POWER, positions, SENSOR_HEIGHT + FILAMENT_HEIGHT)
    offsets = positions[:, None] - np.array(SENSOR_POSITIONS)
    angles = np.angle(np.exp(1j * (np.arctan2(offsets[..., 1], offsets[..., 0]) - SENSOR_HEADINGS)))
    falloff = np.maximum(1 - np.hypot(offsets[..., 0], offsets[..., 1]) / 0.25, 0)
    light = np.where(np.abs(angles) < np.pi / 3, np.cos(1.5 * angles) * falloff * 450, 0)
    grid = table.counts.reshape(len(np.unique(distances)), -1, N_SENSORS).transpose(0, 2, 1)
    noise = np.sqrt(noise_variance(grid).mean(axis=0))
    michel = np.maximum(500 - light, 50) - table.counts
    return distances, (modelled - table.counts) * scale, michel * scale, noise * scale


def sampled_light(folder: Path, far: bool) -> Outcome:
    """Compare the sampled lamp from 113 mm on, or nearer."""
    distances, errors, michel, noise = sampled_errors(folder)
    part = (distances >= FAR) == far
    return Outcome(rms([errors[part]]), rms([noise]), {"Michel's simulator": rms([michel[part]])})


def figure_9(folder: Path) -> Outcome:
    """Compare a lamp of 1 W straight before a sensor, by the sensor that fits best."""
    table = columns(folder / "manual_data" / "k1_fig9_ambient_vs_distance_1W.csv")
    distances, measured = table["distance_mm"] / 1e3, table["ambient_raw"].astype(float)
    robot, headings = _robot("khepera1-manual"), _headings("khepera1-manual")
    errors: dict[int, Floats] = {}
    for sensor in _FRONT_SENSORS:
        axis = np.array([math.cos(headings[sensor]), math.sin(headings[sensor])])
        positions = np.array(SENSOR_POSITIONS[sensor]) + distances[:, None] * axis
        errors[sensor] = lamp_counts(robot, 1.0, positions, SENSOR_HEIGHT)[:, sensor] - measured
    figures = [rms([error]) for error in errors.values()]
    michel = np.maximum(500 - 450 * np.maximum(1 - distances / 0.25, 0), 50) - measured
    return Outcome(min(figures), None, {"Michel's simulator": rms([michel])})


def figure_10(folder: Path) -> Outcome:
    """Compare the lobes of six receivers with a fitted depth for each."""
    table = columns(folder / "manual_data" / "k1_fig10_ambient_vs_angle.csv")
    robot, calibrated = _robot("khepera1-manual"), calibration.read("khepera1-manual")[0].ambient
    errors: list[Floats] = []
    for sensor, name in enumerate(dict.fromkeys(table["sensor"].tolist())):
        rows = table["sensor"] == name
        # Bearings are printed clockwise; the power leaves the receiver unsaturated.
        angles = -np.radians(table["light_bearing_deg"][rows].astype(float))
        positions = _FIGURE_10_MM / 1e3 * np.column_stack([np.cos(angles), np.sin(angles)])
        depth = calibrated.dark_counts - lamp_counts(robot, 1.0, positions, SENSOR_HEIGHT)[:, sensor]
        measured = calibrated.dark_counts - table["ambient_raw"][rows]
        errors.append(depth * (depth @ measured) / (depth @ depth) - measured)
    sensor_rms = sorted(rms([error]) for error in errors)
    return Outcome(rms(errors), None, note=f"{sensor_rms[0]:.0f} to {sensor_rms[-1]:.0f} by receiver")


def khepera2_figure_8(folder: Path) -> Outcome:
    """Compare a lamp of 50 W right above a Khepera II."""
    table = columns(folder / "manual_data" / "k2_fig8_ambient_vs_distance_50W_overhead.csv", float)
    robot = _robot("khepera2")
    errors: list[Floats] = []
    distances_mm = table["lamp_distance_mm"]
    for distance_mm in np.unique(distances_mm[np.isfinite(distances_mm)]):
        rows = distances_mm == distance_mm
        (modelled,) = lamp_counts(robot, 50.0, np.zeros((1, 2)), BODY_HEIGHT + distance_mm / 1e3)
        errors.append(modelled[table["sensor"][rows].astype(int)] - table["ambient_raw"][rows])
    return Outcome(rms(errors))


def _robot(name: str) -> RobotEntry:
    model = "khepera2" if name == "khepera2" else "khepera1"
    return RobotEntry(x_mm=500, y_mm=500, heading_deg=0, model=model, calibration=name)


def _headings(name: str) -> Floats:
    return np.radians(calibration.read(name)[0].ambient.heading_deg)


COMPARISONS = (
    Comparison(
        "lamp of 2 W, from 113 mm on",
        _SAMPLED,
        "fitted: heading, gain and lobe of each receiver",
        "of 1023",
        lambda folder: sampled_light(folder, True),
    ),
    Comparison(
        "lamp of 2 W, nearer",
        _SAMPLED,
        "fitted with a fourth of its weight",
        "of 1023",
        lambda folder: sampled_light(folder, False),
    ),
    Comparison(
        "lamp of 1 W ahead (figure 9)",
        "Khepera manual 5.02",
        "fitted: gain, offset, brightest level",
        "counts",
        figure_9,
    ),
    Comparison(
        "lobes of six receivers (figure 10)",
        "Khepera manual 5.02",
        "fitted: heading, lobe and depth of each",
        "counts",
        figure_10,
    ),
    Comparison(
        "Khepera II, 50 W above (figure 8)",
        "Khepera II manual 1.1",
        "fitted: diffuse part, dark and brightest level",
        "counts",
        khepera2_figure_8,
    ),
)
"""Comparisons of ambient light, in the page's order."""
