"""Metrics of an episode: sums over its control periods, and the results computed from them.

A new metric needs a field of `Metrics` and a value in `compute_period`; it is then a column of every result.
Metrics are means over the control periods, except `TOTALS`. The functions run interpreted and compiled.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.compilable import compilable
from khep_twin.episodes import fitness
from khep_twin.robots.core import Registers
from khep_twin.robots.model import Interface
from khep_twin.sensing.buffers import Vector


class Metrics(NamedTuple):
    """Metrics of an episode, or the summands of one control period."""

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
"""Metrics that are sums over an episode: the distance, and the distance forwards minus that backwards."""

N_METRICS = len(METRICS)
PERIODS, CHARGE, LAST_X, LAST_Y = N_METRICS, N_METRICS + 1, N_METRICS + 2, N_METRICS + 3
"""Indices in a robot's sums, behind those of the metrics: number of control periods, remaining charge [s],
and last position of the robot [m]."""
N_SUMS = N_METRICS + 4


def initial_sums(n_robots: int, home: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sums of robots at the start of an episode (n_robots, N_SUMS).

    Args:
        n_robots: Number of robots.
        home: Home x, y, radius [m] and time for which a full battery lasts [s] (4,); radius 0 for none.
    """
    sums = np.zeros((n_robots, N_SUMS))
    sums[:, CHARGE] = home[3]
    if not home[2]:
        sums[:, METRICS.index("homing")] = math.nan
    return sums


def compute_metrics(sums: NDArray[np.float64]) -> dict[str, float]:
    """Return the metrics of a robot from its sums (N_SUMS,)."""
    return {name: float(value) for name, value in compute_means(sums).items()}


def compute_means(sums: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the metrics of robots from their sums (..., N_SUMS), each (...)."""
    periods = np.maximum(sums[..., PERIODS], 1.0)
    totals = {name: sums[..., metric] for metric, name in enumerate(METRICS)}
    return {name: total if name in TOTALS else total / periods for name, total in totals.items()}


@compilable
def add_period(
    registers: Registers,
    interface: Interface,
    sums: Vector[float],
    home: Vector[float],
    lights: tuple[float, float],
    pose: tuple[float, float, float, float],
    period: float,
) -> None:
    """Add the summands of a control period, from its readings and the speeds just set.

    Args:
        registers: Registers of the robot.
        interface: Meaning of the registers.
        sums: Sums over the episode, changed in place (N_SUMS,).
        home: Home as in `initial_sums`.
        lights: Ambient readings in the dark and in the brightest light [counts].
        pose: Robot x and y [m], cosine and sine of its heading.
        period: Control period [s].
    """
    period_metrics = compute_period(registers, interface, sums, home, lights, pose)
    for metric in range(N_METRICS):
        sums[metric] += period_metrics[metric]
    sums[LAST_X], sums[LAST_Y] = pose[0], pose[1]
    sums[PERIODS] += 1
    if home[2] > 0 and sums[CHARGE] > 0:
        # At home the battery is charged instantly.
        sums[CHARGE] = home[3] if _is_home(home, pose) else sums[CHARGE] - period


@compilable
def compute_period(
    registers: Registers,
    interface: Interface,
    sums: Vector[float],
    home: Vector[float],
    lights: tuple[float, float],
    pose: tuple[float, float, float, float],
) -> Metrics:
    """Return the summands of a control period; arguments are those of `add_period`."""
    nearest, lowest = registers[interface.proximity[0]], registers[interface.ambient[0]]
    for register in range(interface.proximity[0], interface.proximity[1]):
        nearest = max(nearest, registers[register])
    for register in range(interface.ambient[0], interface.ambient[1]):
        lowest = min(lowest, registers[register])
    side = max(registers[interface.sides[0]], registers[interface.sides[1]])
    speed_scale = fitness.TOP_SPEED_PULSES / interface.top_speed
    left = registers[interface.setpoints[0]] * speed_scale
    right = registers[interface.setpoints[1]] * speed_scale
    proximity = _nearness(interface, nearest)
    dx, dy = (pose[0] - sums[LAST_X], pose[1] - sums[LAST_Y]) if sums[PERIODS] > 0 else (0.0, 0.0)
    is_away = home[2] > 0 and sums[CHARGE] > 0 and not _is_home(home, pose)
    return Metrics(
        obstacle_avoidance=fitness.obstacle_avoidance(left, right, proximity),
        light_seeking=fitness.light_seeking(float(lowest), lights[0], lights[1]),
        homing=fitness.homing(left, right, proximity) if is_away else 0.0,
        wall_following=fitness.wall_following(left, right, _nearness(interface, side)),
        effort=fitness.effort(left, right),
        distance_m=math.sqrt(dx * dx + dy * dy),
        forward_m=dx * pose[2] + dy * pose[3],
    )


@compilable
def _nearness(interface: Interface, counts: int) -> float:
    """Return proximity as a part of its range, 0 to 1."""
    return max(counts - interface.counts[0], 0) / (interface.counts[1] - interface.counts[0])


@compilable
def _is_home(home: Vector[float], pose: tuple[float, float, float, float]) -> bool:
    """Return whether a robot is within the radius of its home."""
    dx, dy = pose[0] - home[0], pose[1] - home[1]
    return dx * dx + dy * dy <= home[2] * home[2]
