"""Comparisons of proximity with the sampled robot.

All counts of the twin are read from a robot put before the object in MuJoCo, without noise. Only the fits
that leave an object out use the planar model of `khep_twin.lab.fit`.
"""

import math
from functools import cache
from pathlib import Path

import numpy as np

from khep_twin.units import BODY_RADIUS, N_SENSORS, SENSOR_HEADINGS, Sensor
from studies.fidelity_comparison import Comparison, Floats, Outcome, noise_variance, read_at_rest
from studies.infrared_fits import MeasuredTable, compare, fit_sampled, on_axis, rms, sampled
from studies.infrared_picture import PEERS
from studies.one_object import CYLINDER, WALL, Target, scene
from studies.sampled_world import along_axes

_SAMPLED = "one Khepera, sampled at CNR Rome"
_SIDE_MM = 3000.0


def peer_curve(name: str, distances: Floats) -> Floats:
    """Return the counts of another simulator over distances [m]."""
    at, counts = PEERS[name]
    return np.clip(np.interp(distances * 1e3, at, counts, right=0), 0, 1023)


@cache
def modelled_table(folder: Path, target: Target) -> tuple[MeasuredTable, Floats]:
    """Return the sampled table of an object, and the twin's counts at its poses (n, 8)."""
    table = sampled(folder)[0 if target is WALL else 1]
    away = (table.distances + BODY_RADIUS + target.radius) * 1e3
    object_mm = _SIDE_MM if target is WALL else _SIDE_MM / 2
    headings = -np.degrees(table.bearings)
    starts = np.column_stack([object_mm - away, np.full(len(away), _SIDE_MM / 2), headings])
    return table, read_at_rest(scene(target), starts)[0]


def compare_on_axis(folder: Path, target: Target) -> Outcome:
    """Compare means within 6 degrees of each sensor's peak."""
    table, modelled = modelled_table(folder, target)
    errors: list[Floats] = []
    peer_errors: dict[str, list[Floats]] = {name: [] for name in PEERS}
    floors: list[float] = []
    for sensor in range(N_SENSORS):
        axis, measured = on_axis(table, sensor), table.counts[:, sensor]
        errors.append(axis @ (modelled[:, sensor] - measured))
        for name in PEERS:
            peer_errors[name].append(axis @ (peer_curve(name, table.distances) - measured))
        for row in axis:
            near = np.flatnonzero(row)
            floors.append(float(noise_variance(measured[near])) / len(near))
    peers = {name: rms(curve_errors) for name, curve_errors in peer_errors.items()}
    worst = max(range(N_SENSORS), key=lambda sensor: rms([errors[sensor]]))
    note = f"worst sensor {sensor_name(worst)}, {rms([errors[worst]]):.0f}"
    return Outcome(rms(errors), math.sqrt(float(np.mean(floors))), peers, note)


def compare_all_bearings(folder: Path) -> Outcome:
    """Compare both objects at all bearings."""
    errors: list[Floats] = []
    noise: list[Floats] = []
    peer_errors: dict[str, list[Floats]] = {name: [] for name in PEERS}
    for target in (WALL, CYLINDER):
        table, modelled = modelled_table(folder, target)
        errors.append(modelled - table.counts)
        for name in PEERS:
            peer_counts, _ = along_axes(target, lambda lengths, name=name: peer_curve(name, lengths))(
                table.distances, table.bearings
            )
            peer_errors[name].append(peer_counts - table.counts)
        grid = table.counts.reshape(len(np.unique(table.distances)), -1, N_SENSORS)
        noise.append(noise_variance(grid.transpose(0, 2, 1)))
    floor = math.sqrt(float(np.mean(noise)))
    note = f"wall {rms([errors[0]]):.0f}, cylinder {rms([errors[1]]):.0f}"
    return Outcome(
        rms(errors), floor, {name: rms(curve_errors) for name, curve_errors in peer_errors.items()}, note
    )


def compare_half_scale(folder: Path, target: Target) -> Outcome:
    """Compare the distance at half scale of each sensor [mm]."""
    table, modelled = modelled_table(folder, target)
    distances = np.unique(table.distances) * 1e3
    differences: list[float] = []
    peer_differences: dict[str, list[float]] = {name: [] for name in PEERS}
    for sensor in range(N_SENSORS):
        axis = on_axis(table, sensor)

        def half(counts: Floats, axis: Floats = axis) -> float:
            return float(np.interp(-511.5, -(axis @ counts), distances))

        measured = half(table.counts[:, sensor])
        differences.append(half(modelled[:, sensor]) - measured)
        for name in PEERS:
            peer_differences[name].append(half(peer_curve(name, table.distances)) - measured)
    peers = {name: rms([np.array(values)]) for name, values in peer_differences.items()}
    return Outcome(rms([np.array(differences)]), None, peers, f"worst {max(map(abs, differences)):.1f}")


def compare_left_out(folder: Path, fitted: int, judged: int) -> Outcome:
    """Fit all sensors to one object alone, and compare the other on axis."""
    tables = sampled(folder)
    errors: list[Floats] = []
    for sensor in range(N_SENSORS):
        heading, optics = fit_sampled([tables[fitted]], sensor, SENSOR_HEADINGS[sensor])
        errors.append(compare(tables[judged], sensor, heading, optics).on_axis)
    floor = compare_on_axis(folder, (WALL, CYLINDER)[judged]).floor
    return Outcome(rms(errors), floor, note="offset and lobe drawn to 4 mm and 3, which are assumed")


def sensor_name(sensor: int) -> str:
    return Sensor(sensor).label


_FITTED = "fitted: heading and optics of each sensor"

COMPARISONS = (
    Comparison("wall, on axis", _SAMPLED, _FITTED, "counts", lambda folder: compare_on_axis(folder, WALL)),
    Comparison(
        "cylinder of 27 mm radius, on axis",
        _SAMPLED,
        _FITTED,
        "counts",
        lambda folder: compare_on_axis(folder, CYLINDER),
    ),
    Comparison("wall and cylinder, all bearings", _SAMPLED, _FITTED, "counts", compare_all_bearings),
    Comparison(
        "cylinder on axis, fitted to the wall alone",
        _SAMPLED,
        "predicted",
        "counts",
        lambda folder: compare_left_out(folder, 0, 1),
    ),
    Comparison(
        "wall on axis, fitted to the cylinder alone",
        _SAMPLED,
        "predicted",
        "counts",
        lambda folder: compare_left_out(folder, 1, 0),
    ),
    Comparison(
        "wall, distance at half scale",
        _SAMPLED,
        _FITTED,
        "mm",
        lambda folder: compare_half_scale(folder, WALL),
    ),
    Comparison(
        "cylinder, distance at half scale",
        _SAMPLED,
        _FITTED,
        "mm",
        lambda folder: compare_half_scale(folder, CYLINDER),
    ),
)
"""Comparisons with the sampled robot, in the page's order."""
