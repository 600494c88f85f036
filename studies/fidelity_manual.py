"""Comparisons of proximity with the figures of the manuals and other Khepera IIs.

Distances are those from a sensor's face to a wall; before a Khepera II, from the foremost face.
"""

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from khep_twin.playpen import Arena, Cylinder, Playpen, RobotEntry
from khep_twin.playpen.surfaces import Surface
from khep_twin.sensing import calibration
from khep_twin.units import N_SENSORS
from studies.fidelity_comparison import Comparison, Floats, Outcome, columns, read_at_rest
from studies.fidelity_proximity import peer_curve, sensor_name
from studies.infrared_fits import (
    MANUAL_SURFACES,
    OBSTACLE_REFLECTANCE,
    materials,
    rms,
)
from studies.infrared_picture import PEERS
from studies.khepera2_fits import (
    FACING_DEG,
    FITTED_DAYS,
    ON_AXIS,
    Report,
    khepera2_report,
    pykhepera_wall,
)

_FACING = ON_AXIS, (5,)
"""Sensors of a Khepera II that face an object ahead, and an object at its right side."""

_MANUAL = "Khepera manual 5.02"
_REPORT = "K-Team's report on the Khepera II, 2002"
_PYKHEPERA = "two of five days of pykhepera's calibration, Edinburgh 2013; wall of unknown material"
_SIDE_MM = 3000.0
_SURFACES = {"obstacle": Surface(reflectance=OBSTACLE_REFLECTANCE, rgb=(255, 255, 255))}
_SIX = range(6)
"""Sensors of the manual's figures: all but those at the back."""

OBSTACLE_RADIUS_MM, OBSTACLE_MM = 3.5, 15.0
"""The manual's obstacle of 7 mm, taken as round, and its distance from the sensor's face [mm]."""


def face_to_face(name: str, sensor: int, distances_mm: Floats, surface: str = "white") -> Floats:
    """Return the counts of a sensor over the distance of its face from a wall; NaN in contact."""
    robot = _robot(name)
    heading = math.radians(calibration.read(name)[0].heading_deg[sensor])
    forward, left = robot.body.sensor_positions[sensor]
    away_mm = distances_mm + (forward * math.cos(heading) + left * math.sin(heading)) * 1e3
    arena = Arena(width_mm=_SIDE_MM, height_mm=_SIDE_MM, surface=surface)
    starts = [[_SIDE_MM - away, _SIDE_MM / 2, -math.degrees(heading)] for away in away_mm]
    clear = away_mm >= robot.body.radius * 1e3
    counts = np.full(len(away_mm), np.nan)
    counts[clear] = read_at_rest(_playpen(arena, robot), np.array(starts)[clear])[0][:, sensor]
    return counts


def figure_11(folder: Path) -> Outcome:
    """Compare the materials of the manual, by the sensor that fits best."""
    measured = {name: curve for name, curve in materials(folder).items() if name in MANUAL_SURFACES}

    def errors(sensor: int) -> Floats:
        differences = [
            face_to_face("khepera1-manual", sensor, distances * 1e3, MANUAL_SURFACES[name]) - counts
            for name, (distances, counts) in measured.items()
        ]
        return np.concatenate(differences)

    return _best({sensor: errors(sensor) for sensor in _SIX})


def figure_12(folder: Path) -> Outcome:
    """Compare a thin obstacle around a sensor, by the sensor that fits best."""
    table = columns(folder / "manual_data" / "k1_fig12_proximity_vs_angle_7mm_obstacle_15mm.csv")
    measured = table["proximity_raw"].astype(float)
    calibrated, robot = calibration.read("khepera1-manual")[0], _robot("khepera1-manual")
    middle = _SIDE_MM / 2
    obstacle = Cylinder(
        x_mm=middle, y_mm=middle, radius_mm=OBSTACLE_RADIUS_MM, height_mm=50, surface="obstacle"
    )
    arena = Arena(width_mm=_SIDE_MM, height_mm=_SIDE_MM)
    away = OBSTACLE_MM + OBSTACLE_RADIUS_MM

    def errors(sensor: int) -> Floats:
        forward, left = (coordinate * 1e3 for coordinate in robot.body.sensor_positions[sensor])
        outwards = 1 if left > 0 else -1
        angles = np.radians(calibrated.heading_deg[sensor] + outwards * table["obstacle_angle_deg"])
        positions_mm = np.column_stack([forward + away * np.cos(angles), left + away * np.sin(angles)])
        starts = np.column_stack([middle - positions_mm, np.zeros(len(positions_mm))])
        return read_at_rest(_playpen(arena, robot, cylinders=(obstacle,)), starts)[0][:, sensor] - measured

    return _best({sensor: errors(sensor) for sensor in _SIX})


def figure_13(folder: Path) -> Outcome:
    """Compare six sensors before wood."""
    table = columns(folder / "manual_data" / "k1_fig13_proximity_vs_distance_wood_6sensors.csv")
    errors: list[Floats] = []
    peer_errors: dict[str, list[Floats]] = {name: [] for name in PEERS}
    for sensor in _SIX:
        rows = table["sensor"] == f"sensor_{sensor + 1}"
        distances = table["distance_mm"][rows].astype(float)
        measured = np.minimum(table["proximity_raw"][rows], 1023).astype(float)
        errors.append(face_to_face("khepera1-manual", sensor, distances, "wood") - measured)
        for name in PEERS:
            peer_errors[name].append(peer_curve(name, distances / 1e3) - measured)
    return Outcome(rms(errors), None, {name: rms(curve_errors) for name, curve_errors in peer_errors.items()})


def khepera2_facing(folder: Path) -> Outcome:
    """Compare the sensors of a Khepera II that face white paper."""
    errors: dict[str, list[Floats]] = {name: [] for name in ("khepera2-manual", "khepera2", *PEERS)}
    for curve in khepera2_report(folder):
        if not curve.is_robot and curve.sensor in _FACING[curve.is_aside]:
            for name in errors:
                counts = peer_curve(name, curve.distances) if name in PEERS else _modelled_counts(curve, name)
                errors[name].append(counts - curve.counts)
    manual_name, middle_name, *_ = figures = {
        name: rms(curve_errors) for name, curve_errors in errors.items()
    }
    return Outcome(
        figures[manual_name],
        None,
        {name: figures[name] for name in PEERS},
        f"`khepera2`, the middle of two robots, {figures[middle_name]:.0f}",
    )


def khepera2_oblique(folder: Path) -> Outcome:
    """Compare the sensors of a Khepera II that look past white paper."""
    errors: list[Floats] = []
    notes: list[str] = []
    for curve in khepera2_report(folder):
        if not curve.is_robot and curve.sensor not in _FACING[curve.is_aside]:
            modelled, nearest = _modelled_counts(curve), curve.distances.argmin()
            errors.append(modelled - curve.counts)
            notes.append(
                f"{modelled[nearest]:.0f} for {curve.counts[nearest]:.0f} "
                f"at {curve.distances[nearest] * 1e3:.0f} mm"
            )
    return Outcome(rms(errors), None, note=", ".join(notes))


def khepera2_robot(folder: Path) -> Outcome:
    """Compare a Khepera II before another one."""
    errors: dict[bool, list[Floats]] = {True: [], False: []}
    for curve in khepera2_report(folder):
        if curve.is_robot:
            errors[curve.sensor in _FACING[curve.is_aside]].append(_modelled_counts(curve) - curve.counts)
    facing, oblique = (rms(errors[key]) for key in (True, False))
    return Outcome(
        rms([*errors[True], *errors[False]]), None, note=f"facing {facing:.0f}, oblique {oblique:.0f}"
    )


def pykhepera(folder: Path, sensors: Sequence[int]) -> Outcome:
    """Compare sensors of another Khepera II, each turned to a wall, on days that were not fitted."""
    wall = pykhepera_wall(folder)
    robot, arena = _robot("khepera2"), Arena(width_mm=_SIDE_MM, height_mm=_SIDE_MM)
    test_days = [day for day in np.unique(wall.days).tolist() if day not in FITTED_DAYS]
    errors: dict[str, list[Floats]] = {name: [] for name in ("twin", "days", *PEERS)}
    for sensor in sensors:
        gaps, measured = wall.means(sensor, test_days)
        away = _SIDE_MM - robot.body.radius * 1e3 - gaps * 1e3
        starts = [[x_mm, _SIDE_MM / 2, -FACING_DEG[sensor]] for x_mm in away]
        errors["twin"].append(read_at_rest(_playpen(arena, robot), np.array(starts))[0][:, sensor] - measured)
        errors["days"] += [wall.means(sensor, [day])[1] - measured for day in test_days]
        for name in PEERS:
            errors[name].append(peer_curve(name, gaps) - measured)
    figure, floor, *peer_rms = (rms(sensor_errors) for sensor_errors in errors.values())
    return Outcome(figure, floor, dict(zip(PEERS, peer_rms, strict=True)))


def _modelled_counts(curve: Report, name: str = "khepera2-manual") -> Floats:
    """Return a Khepera II's counts before white paper or a robot, at distances from its foremost face."""
    robot, sensor = _robot(name), curve.sensor
    turn = 90.0 if curve.is_aside else 0.0
    reach = max(-left if curve.is_aside else forward for forward, left in robot.body.sensor_positions) * 1e3
    arena = Arena(width_mm=_SIDE_MM, height_mm=_SIDE_MM)
    away = curve.distances * 1e3 + reach
    if not curve.is_robot:
        starts = [[_SIDE_MM - distance, _SIDE_MM / 2, turn] for distance in away]
        return read_at_rest(_playpen(arena, robot), np.array(starts))[0][:, sensor]
    away = away + robot.body.radius * 1e3
    pair_starts = [[[1000.0, 1500.0, turn], [1000.0 + distance, 1500.0, 180.0]] for distance in away]
    other = robot.model_copy(update={"x_mm": 2000.0})
    return read_at_rest(_playpen(arena, robot, other), np.array(pair_starts))[0][:, sensor]


def _best(errors: dict[int, Floats]) -> Outcome:
    figures = {sensor: rms([differences[~np.isnan(differences)]]) for sensor, differences in errors.items()}
    best = min(figures, key=lambda sensor: figures[sensor])
    range_text = f"{min(figures.values()):.0f} to {max(figures.values()):.0f} by sensor"
    return Outcome(figures[best], None, note=f"{sensor_name(best)}, the best of six: {range_text}")


def _robot(name: str) -> RobotEntry:
    model = "khepera2" if name.startswith("khepera2") else "khepera1"
    return RobotEntry(x_mm=1000, y_mm=1500, heading_deg=0, model=model, calibration=name)


def _playpen(arena: Arena, *robots: RobotEntry, cylinders: tuple[Cylinder, ...] = ()) -> Playpen:
    return Playpen(version=1, name="bench", arena=arena, robot=robots, cylinder=cylinders, surfaces=_SURFACES)


COMPARISONS = (
    Comparison(
        "materials (figure 11)",
        _MANUAL,
        "fitted: optics of the sensor, reflectance of each material",
        "counts",
        figure_11,
    ),
    Comparison(
        "obstacle of 7 mm around a sensor (figure 12)",
        _MANUAL,
        "fitted: lobe, reflectance of the obstacle",
        "counts",
        figure_12,
    ),
    Comparison(
        "wood before six sensors (figure 13)",
        _MANUAL,
        "fitted: gain, threshold, offset of each",
        "counts",
        figure_13,
    ),
    Comparison(
        "Khepera II, white paper ahead", _REPORT, "fitted: gain, threshold, offset", "counts", khepera2_facing
    ),
    Comparison(
        "another Khepera II, wall ahead",
        _PYKHEPERA,
        "fitted: one gain, between it and the report's robot; readings at rest; on three other days",
        "counts",
        partial(pykhepera, sensors=ON_AXIS),
    ),
    Comparison(
        "another Khepera II, wall at its other sensors",
        _PYKHEPERA,
        "predicted; readings at rest fitted on three other days",
        "counts",
        partial(pykhepera, sensors=[sensor for sensor in range(N_SENSORS) if sensor not in ON_AXIS]),
    ),
    Comparison(
        "Khepera II, white paper aside",
        _REPORT,
        "fitted: gain, threshold, offset",
        "counts",
        khepera2_oblique,
    ),
    Comparison(
        "Khepera II, another robot", _REPORT, "fitted: reflectance of the shell", "counts", khepera2_robot
    ),
)
"""Comparisons with the manuals' figures, in the page's order."""
