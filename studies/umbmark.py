"""UMBmark, the square of Borenstein and Feng.

A host drives a square of 500 mm five times to the left and five times to the right with the moves of
`khep_twin.host` (commands C and H, up to 160 mm/s), and compares the robot's final position with
that of its encoders. The means c of the errors of each direction yield, to the first order, after J.
Borenstein and L. Feng (Measurement and Correction of Systematic Odometry Errors in Mobile Robots,
IEEE Transactions on Robotics and Automation, 1996):

    E_max = max(|c_left|, |c_right|)    largest systematic error
    E_d                                 radius of the right wheel over that of the left
    E_b                                 wheel base over the nominal one, both per wheel radius

Their square of 4 m is scaled to the robot. The nominal robot and twenty of the same model drive it. The table
compares the true wheels with those that the squares yield.
"""

import math
from contextlib import suppress
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from khep_twin.errors import MoveError
from khep_twin.host import Khepera
from khep_twin.randomness import stream
from khep_twin.sensing import calibration
from khep_twin.units import WHEEL_BASE
from studies.home_test import Odometry, open_arena, true_pose, twin
from tools.command_table import command_line

SIDE = 0.5
"""Side of the square [m]."""

RUNS = 5
ROBOTS = range(1, 21)

_LONGEST_S = 6.0
"""Longest wait for the end of a side, which takes 4 s."""


class Umbmark(NamedTuple):
    """Result of one robot.

    Attributes:
        largest: Largest systematic error [m].
        scatter: Standard deviation of the runs of a direction, in x or y, the larger [m].
        wheels: Radius of the right wheel over that of the left, E_d.
        base: Wheel base over the nominal one, E_b.
    """

    largest: float
    scatter: float
    wheels: float
    base: float


def umbmark(robot: Khepera) -> Umbmark:
    """Drive all squares with a twin."""
    errors = [np.array([_square(robot, side) for _ in range(RUNS)]) for side in (1, -1)]
    left, right = (ends.mean(axis=0).tolist() for ends in errors)
    scatter = max(float(ends.std(axis=0, ddof=1).max()) for ends in errors)
    return Umbmark(max(math.hypot(*left), math.hypot(*right)), scatter, *factors(left[0], right[0]))


def factors(left: float, right: float) -> tuple[float, float]:
    """Return E_d and E_b of the mean errors along the first side, of squares to the left and right [m].

    An excess turn a at each corner, and a bend b of each side to the left, displace the end of a square to
    the left by 2 side (a + b) along its first side, and one to the right by 2 side (a - b).
    """
    corner, bend = (left + right) / (4 * SIDE), (left - right) / (4 * SIDE)
    half = math.sin(bend / 2) / SIDE * WHEEL_BASE
    return (1 + half) / (1 - half), 1 / (1 + corner / (math.pi / 2))


def draw_wheels(seed: int) -> tuple[float, float]:
    """Return E_d and E_b of the wheels that a seed draws."""
    nominal = calibration.read("khepera1")[0]
    wheels = calibration.vary(nominal, stream(seed, "robot", 0, "spread")).wheels if seed else nominal.wheels
    scale = wheels.radius_mm / nominal.wheels.radius_mm
    return wheels.right_over_left, wheels.base_mm / nominal.wheels.base_mm / scale


def _square(robot: Khepera, side: int) -> tuple[float, float]:
    """Drive one square; return the true end less that of the odometry, x along the first side [m]."""
    start_x, start_y, start_heading = true_pose(robot)
    odometry = Odometry(robot)
    for _ in range(4):
        for move, distance in ((robot.move, SIDE), (robot.turn, side * math.pi / 2)):
            # A wheel may oscillate around its target by a pulse or two; the host then continues.
            with suppress(MoveError):
                move(distance, timeout=_LONGEST_S)
            odometry.update()
    x, y, _ = true_pose(robot)
    dx, dy, c, s = x - start_x, y - start_y, math.cos(start_heading), math.sin(start_heading)
    return c * dx + s * dy - odometry.x, c * dy - s * dx - odometry.y


def main() -> None:
    command_line(__doc__).parse_args()
    print("robot   E_max [mm]  scatter [mm]       E_d   drawn        E_b   drawn")
    results: list[Umbmark] = []
    with TemporaryDirectory() as folder:
        arena = open_arena(folder)
        for seed in (0, *ROBOTS):
            with twin(arena, seed) as robot:
                results.append(result := umbmark(robot))
            wheels, base = draw_wheels(seed)
            print(
                f"{seed or 'nominal':<9}{result.largest * 1e3:9.1f}{result.scatter * 1e3:14.2f}"
                f"{result.wheels:12.4f}{wheels:8.4f}{result.base:11.4f}{base:8.4f}",
                flush=True,
            )
    largest = np.array([mark.largest * 1e3 for mark in results[1:]])
    low, middle, high = np.percentile(largest, (10, 50, 90))
    print(f"E_max of robots of the same make: median {middle:.0f} mm, 10 to 90 %: {low:.0f} to {high:.0f} mm")
    wheels, base = np.std([mark.wheels for mark in results[1:]]), np.std([mark.base for mark in results[1:]])
    print(f"standard deviations of E_d {wheels:.4f}, of E_b {base:.4f}")
