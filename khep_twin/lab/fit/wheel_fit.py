"""Wheels of one robot, from drives that were recorded and measured with a ruler.

    distance = r 2 pi / 600 (n_left + n_right) / 2
    turned   = r 2 pi / 600 (n_right - n_left) / base

over drives with n pulses on either wheel, 600 pulses to a turn of the wheel: wheel radius r and base by least
squares, each drive weighted by how well a ruler can tell it.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin.errors import FitError
from khep_twin.lab.fit.least_squares import CONFIDENCE
from khep_twin.log.reader import read
from khep_twin.sensing.calibration import WheelCalibration
from khep_twin.units import PULSES_PER_TURN, WHEEL_BASE, WHEEL_RADIUS

RULER = 0.0005
"""Standard deviation of a distance measured with a ruler [m] (assumed)."""

PROTRACTOR = math.radians(1)
"""Standard deviation of an angle that a person tells [rad] (assumed)."""

_WIDEST = 0.1
"""Half a confidence interval, relative, beyond which the drives do not tell radius or base."""

_LEAST_DISTANCE, _LEAST_TURNED = 0.1, math.pi


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive from rest to rest.

    Attributes:
        name: what to call it.
        left: pulses of the left wheel.
        right: pulses of the right wheel.
        distance: driven straight, by the ruler [m]; None for a turn on the spot.
        turned: counter-clockwise, as a person has counted [rad]; None for a straight drive.
    """

    name: str
    left: int
    right: int
    distance: float | None = None
    turned: float | None = None


@dataclass(frozen=True, slots=True)
class WheelFit:
    """Wheels found.

    Attributes:
        radius: of a wheel [m].
        base: from one wheel to the other [m].
        radius_interval: half the width of its 95 % confidence interval [m].
        base_interval: likewise [m].
    """

    radius: float
    base: float
    radius_interval: float
    base_interval: float

    def calibration(self) -> WheelCalibration:
        """As a calibration has them."""
        return WheelCalibration(radius_mm=round(self.radius * 1e3, 4), base_mm=round(self.base * 1e3, 3))


def fit_wheels(drives: Sequence[Drive]) -> WheelFit:
    """Finds the wheels that the drives were made on.

    Raises:
        FitError: the drives cannot tell the radius or the base, or contradict themselves.
    """
    for drive in drives:
        _check_kind(drive)
    if not any(abs(drive.distance or 0) >= _LEAST_DISTANCE for drive in drives):
        raise FitError(
            "the wheels' radius cannot be told: no straight drive of 10 cm and more; right is LOG=998mm"
        )
    if not any(abs(drive.turned or 0) >= _LEAST_TURNED for drive in drives):
        raise FitError("the wheel base cannot be told: no half turn and more; right is LOG=5turns")

    def left(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([left_over(drive, *x) / _precision(drive) for drive in drives])

    found = least_squares(left, [WHEEL_RADIUS, WHEEL_BASE], x_scale=[1e-3, 1e-2])
    radius, base = (float(value) for value in found.x)
    # Rulers cannot be better than assumed; where drives differ by more, that counts.
    excess = max(1.0, 2 * float(found.cost) / max(len(drives) - 2, 1))
    spread = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * excess)
    try:
        WheelCalibration(radius_mm=radius * 1e3, base_mm=base * 1e3)
    except ValueError:
        raise FitError(
            f"a wheel radius of {radius * 1e3:.2f} mm and a base of {base * 1e3:.1f} mm are no Khepera's; "
            "right are distances in mm and whole turns as counted, counter-clockwise positive"
        ) from None
    found_intervals = CONFIDENCE * float(spread[0]), CONFIDENCE * float(spread[1])
    for name, interval, value in zip(
        ("wheel radius", "wheel base"), found_intervals, (radius, base), strict=True
    ):
        if interval > _WIDEST * value:
            raise FitError(
                f"{name}: cannot be told better than to +-{interval * 1e3:.2g} mm, as the drives contradict "
                "each other; right are distances in mm and turns as they were driven"
            )
    return WheelFit(radius, base, *found_intervals)


def pulses(log: Path) -> tuple[int, int]:
    """How far the counters went between a log's first reply to H and its last.

    Raises:
        LogError: there is no log.
        FitError: the host has not asked H twice, or has set the counters between.
    """
    robots = read(log).robots
    if len(robots) != 1:
        raise FitError(f"{log}: {len(robots)} robots; right is a log of one")
    (track,) = robots.values()
    lines = [line.text for line in track.serial]
    replies = [number for number, text in enumerate(lines) if text.startswith("h,")]
    if len(replies) < 2:
        raise FitError(f"{log}: the counters were not read twice; right is H before and after the drive")
    between = lines[replies[0] : replies[-1]]
    if any(text.startswith("G") or text == "restart" for text in between):
        raise FitError(f"{log}: the counters were set during the drive; right is G only before the first H")
    first, last = (lines[replies[place]].split(",") for place in (0, -1))
    return int(last[1]) - int(first[1]), int(last[2]) - int(first[2])


def left_over(drive: Drive, radius: float, base: float) -> float:
    """What a person has measured of a drive less what its pulses tell [m or rad]."""
    pulse = 2 * math.pi * radius / PULSES_PER_TURN
    if drive.distance is not None:
        return drive.distance - pulse * (drive.left + drive.right) / 2
    return (drive.turned or 0.0) - pulse * (drive.right - drive.left) / base


def _check_kind(drive: Drive) -> None:
    """Refuses a straight drive that turned, a turn that went somewhere, and one with the wrong sign."""
    driven, value = drive.left + drive.right, drive.distance
    other, wish = drive.right - drive.left, "a drive straight on, such as =998mm"
    if value is None:
        driven, other, value = other, driven, drive.turned or 0.0
        wish = "a turn on the spot, such as =5turns, counter-clockwise"
    if abs(driven) < 10 * abs(other) or driven * value <= 0:
        raise FitError(
            f"{drive.name}: the counters went on by {drive.left} left and {drive.right} right; "
            f"right is {wish}, below 0 for the other way"
        )


def _precision(drive: Drive) -> float:
    return RULER if drive.distance is not None else PROTRACTOR
