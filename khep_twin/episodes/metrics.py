"""Metrics of an episode, in one place: what each control period adds, and how that becomes a number.

A new metric is a field of `Metrics` and its value in `of_period`; it then has a column in every result.
Metrics are means over the control periods, but for `TOTALS`. Like the stepping core this runs interpreted and
compiled.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.compilable import compilable
from khep_twin.episodes import fitness
from khep_twin.sensing.buffers import Vector


class Metrics(NamedTuple):
    """Metrics of an episode, or what one control period adds to each."""

    obstacle_avoidance: float
    light_seeking: float
    homing: float
    wall_following: float
    effort: float
    distance_m: float
    forward_m: float


METRICS = Metrics._fields
"""Names of the metrics, in the order of all results."""

TOTALS = ("distance_m", "forward_m")
"""Metrics that are sums over an episode: the distance, and that forwards less that backwards."""

N_METRICS = len(METRICS)
PERIODS, CHARGE, LAST_X, LAST_Y = N_METRICS, N_METRICS + 1, N_METRICS + 2, N_METRICS + 3
"""Indices in a robot's sums, behind those of the metrics: control periods, charge left [s], and last position
of the robot [m]."""
N_SUMS = N_METRICS + 4

_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_LEFT_SETPOINT, _RIGHT_SETPOINT = kernel.SETPOINTS
_SIDES = (int(units.Sensor.LEFT_90), int(units.Sensor.RIGHT_90))
_N = units.N_SENSORS


def sums_at_start(n_robots: int, home: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums of robots at the start of an episode (n_robots, N_SUMS).

    Args:
        n_robots: Number of robots.
        home: Home x, y, radius [m] and duration of the charge [s] (4,); radius 0 for none.
    """
    sums = np.zeros((n_robots, N_SUMS))
    sums[:, CHARGE] = home[3]
    if not home[2]:
        sums[:, METRICS.index("homing")] = math.nan
    return sums


def metrics_of(sums: NDArray[np.float64]) -> dict[str, float]:
    """Return the metrics of a robot from its sums (N_SUMS,)."""
    return {name: float(value) for name, value in means_of(sums).items()}


def means_of(sums: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the metrics of robots from their sums (..., N_SUMS), each (...)."""
    periods = np.maximum(sums[..., PERIODS], 1.0)
    totals = {name: sums[..., metric] for metric, name in enumerate(METRICS)}
    return {name: total if name in TOTALS else total / periods for name, total in totals.items()}


@compilable
def add_period(
    registers: kernel.Registers,
    sums: Vector[float],
    home: Vector[float],
    dark: float,
    floor: float,
    at: tuple[float, float, float, float],
    period: float,
) -> None:
    """Add what the start of a control period tells, with the speeds just set.

    Args:
        registers: State of the board.
        sums: Sums over the episode, changed in place (N_SUMS,).
        home: Home as in `sums_at_start`.
        dark: Ambient reading in the dark [counts].
        floor: Ambient reading in the brightest light [counts].
        at: Robot x and y [m], cosine and sine of its heading.
        period: Control period [s].
    """
    added = of_period(registers, sums, home, dark, floor, at)
    for metric in range(N_METRICS):
        sums[metric] += added[metric]
    sums[LAST_X], sums[LAST_Y] = at[0], at[1]
    sums[PERIODS] += 1
    if home[2] > 0 and sums[CHARGE] > 0:
        # At home the cells are full at once.
        sums[CHARGE] = home[3] if _is_home(home, at) else sums[CHARGE] - period


@compilable
def of_period(
    registers: kernel.Registers,
    sums: Vector[float],
    home: Vector[float],
    dark: float,
    floor: float,
    at: tuple[float, float, float, float],
) -> Metrics:
    """Return what a control period adds to each metric; arguments are those of `add_period`."""
    nearest, darkest = registers[_PROXIMITY], registers[_AMBIENT]
    for sensor in range(1, _N):
        nearest = max(nearest, registers[_PROXIMITY + sensor])
        darkest = min(darkest, registers[_AMBIENT + sensor])
    side = max(registers[_PROXIMITY + _SIDES[0]], registers[_PROXIMITY + _SIDES[1]]) / units.COUNTS_LIMIT
    left, right = float(registers[_LEFT_SETPOINT]), float(registers[_RIGHT_SETPOINT])
    part = nearest / units.COUNTS_LIMIT
    dx, dy = (at[0] - sums[LAST_X], at[1] - sums[LAST_Y]) if sums[PERIODS] > 0 else (0.0, 0.0)
    away = home[2] > 0 and sums[CHARGE] > 0 and not _is_home(home, at)
    return Metrics(
        obstacle_avoidance=fitness.obstacle_avoidance(left, right, part),
        light_seeking=fitness.light_seeking(float(darkest), dark, floor),
        homing=fitness.homing(left, right, part) if away else 0.0,
        wall_following=fitness.wall_following(left, right, side),
        effort=fitness.effort(left, right),
        distance_m=math.sqrt(dx * dx + dy * dy),
        forward_m=dx * at[2] + dy * at[3],
    )


@compilable
def _is_home(home: Vector[float], at: tuple[float, float, float, float]) -> bool:
    """Return whether a robot is within the radius of its home."""
    dx, dy = at[0] - home[0], at[1] - home[1]
    return dx * dx + dy * dy <= home[2] * home[2]
