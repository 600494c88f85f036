"""Fit of one robot's wheels to recorded drives measured with a ruler.

    distance = r 2 pi / 600 (n_left + n_right) / 2
    turned   = r 2 pi / 600 (n_right - n_left) / base

for drives with n pulses on each wheel, 600 pulses per wheel turn. Wheel radius r and wheel base are fitted by
least squares, with each drive weighted by the ruler's precision.
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
from khep_twin.lab.fit.placement import KHEPERA, FittedValue, Ruler
from khep_twin.log.channels import TextLine
from khep_twin.log.reader import read_log
from khep_twin.robots.model import RobotModel
from khep_twin.sensing.calibration import WheelCalibration
from khep_twin.units import PULSES_PER_TURN

_MAX_RELATIVE_INTERVAL = 0.1
"""Largest accepted half width of a confidence interval, relative."""

_MIN_DISTANCE, _MIN_TURN = 0.1, math.pi  # [m], [rad]


@dataclass(frozen=True, slots=True)
class Drive:
    """Drive from rest to rest.

    Attributes:
        name: Name in messages.
        left: Distance of the left wheel [pulses].
        right: Distance of the right wheel [pulses].
        distance: Straight distance by the ruler [m]; None for a turn on the spot.
        turn: Angle counted by a person, counter-clockwise [rad]; None for a straight drive.
    """

    name: str
    left: int
    right: int
    distance: float | None = None
    turn: float | None = None


def fit_wheels(
    drives: Sequence[Drive], ruler: Ruler | None = None, model: RobotModel = KHEPERA
) -> tuple[WheelCalibration, tuple[FittedValue, FittedValue]]:
    """Fit radius and base of the wheels to the drives; return them rounded, and with their intervals.

    Args:
        drives: Measured drives.
        ruler: Precision of their measurement; None for the default.
        model: Model of the robot.

    Raises:
        FitError: The drives do not determine the radius or the base, or contradict each other.
    """
    for drive in drives:
        _check_counters(drive)
    if not any(abs(drive.distance or 0) >= _MIN_DISTANCE for drive in drives):
        raise FitError(
            "the wheels' radius cannot be determined: no straight drive of 10 cm and more; expected LOG=998mm"
        )
    if not any(abs(drive.turn or 0) >= _MIN_TURN for drive in drives):
        raise FitError("the wheel base cannot be determined: no half turn and more; expected LOG=5turns")

    body = model.body
    deviations = np.array([_standard_deviation(drive, ruler or Ruler()) for drive in drives])

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        values = [drive_residual(drive, x[0], x[1], body.pulses_per_turn) for drive in drives]
        return np.array(values) / deviations

    solution = least_squares(residuals, [body.wheel_radius, body.wheel_base], x_scale=[1e-3, 1e-2])
    radius, base = (float(value) for value in solution.x)
    # The noise is that of the ruler, or more if the residuals are larger.
    variance_factor = max(1.0, 2 * float(solution.cost) / max(len(drives) - 2, 1))
    standard_errors = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)) * variance_factor)
    try:
        wheels = WheelCalibration(radius_mm=round(radius * 1e3, 4), base_mm=round(base * 1e3, 3))
    except ValueError:
        raise FitError(
            f"a wheel radius of {radius * 1e3:.2f} mm and a base of {base * 1e3:.1f} mm are not "
            f"{model.dialect.robot_name}'s; expected distances in mm and whole turns as counted, "
            "counter-clockwise positive"
        ) from None
    intervals_mm = (CONFIDENCE * 1e3 * standard_errors).tolist()
    fitted_radius = FittedValue(("wheels", "radius_mm"), radius * 1e3, intervals_mm[0])
    fitted_base = FittedValue(("wheels", "base_mm"), base * 1e3, intervals_mm[1])
    for name, fitted in (("wheel radius", fitted_radius), ("wheel base", fitted_base)):
        if fitted.interval > _MAX_RELATIVE_INTERVAL * fitted.value:
            raise FitError(
                f"{name}: can be determined to +-{fitted.interval:.2g} mm only, as the drives contradict "
                "each other; expected distances in mm and turns as they were driven"
            )
    return wheels, (fitted_radius, fitted_base)


def read_pulses(log: Path, model: RobotModel = KHEPERA) -> tuple[int, int]:
    """Return the changes of both counters, left and right, between a log's first and last replies with them.

    Raises:
        LogError: There is no log.
        FitError: The host did not read them twice, or set the counters in between.
    """
    read, framing, resets = model.dialect.reads["position"], model.dialect.framing, model.fit_bench.resets
    lines = [line.text for line in read_transcript(log, model)]
    rows = [row for row, text in enumerate(lines) if framing.answers(read.request, text)]
    if len(rows) < 2:
        raise FitError(
            f"{log}: the counters were not read twice; expected {read.request} before and after the drive"
        )
    if any(text.startswith(resets) for text in lines[rows[0] : rows[-1]]):
        expected = f"expected {resets[0]} only before the first {read.request}"
        raise FitError(f"{log}: the counters were set during the drive; {expected}")
    (left, right, *_), (end_left, end_right, *_) = (framing.values(lines[row]) for row in (rows[0], rows[-1]))
    return end_left - left, end_right - right


def read_transcript(log: Path, model: RobotModel) -> Sequence[TextLine]:
    """Return the serial transcript of a log's only robot, which is of a model.

    Raises:
        LogError: There is no log.
        FitError: The log has several robots, or none, or one of another model.
    """
    run = read_log(log)
    if len(run.robots) != 1:
        raise FitError(f"{log}: {len(run.robots)} robots; expected a log of one")
    (track,) = run.robots.values()
    if "playpen.toml" in run.attachments:  # no recording of a line, which names no model
        check_family(str(log), track.model.family, model)
    return track.serial


def check_family(name: str, family: str, model: RobotModel) -> None:
    """Raise a `FitError` for a recording of a robot of another family than a model."""
    if family != model.family:
        raise FitError(f"{name}: of a {family}; expected a {model.family}, or --model {family}")


def drive_residual(
    drive: Drive, radius: float, base: float, pulses_per_turn: float = PULSES_PER_TURN
) -> float:
    """Return the residual of a drive: measurement less odometry [m or rad]."""
    pulse_length = 2 * math.pi * radius / pulses_per_turn
    if drive.distance is not None:
        return drive.distance - pulse_length * (drive.left + drive.right) / 2
    return (drive.turn or 0.0) - pulse_length * (drive.right - drive.left) / base


def _check_counters(drive: Drive) -> None:
    """Raise a `FitError` if the counters contradict the kind of a drive, straight or turn, or its sign."""
    main_change, value = drive.left + drive.right, drive.distance
    other_change, expected = drive.right - drive.left, "a drive straight on, such as =998mm"
    if value is None:
        main_change, other_change, value = other_change, main_change, drive.turn or 0.0
        expected = "a turn on the spot, such as =5turns, counter-clockwise"
    if abs(main_change) < 10 * abs(other_change) or main_change * value <= 0:
        raise FitError(
            f"{drive.name}: the counters went on by {drive.left} left and {drive.right} right; "
            f"expected {expected}, below 0 for the other direction"
        )


def _standard_deviation(drive: Drive, ruler: Ruler) -> float:
    """Return the standard deviation of a measurement [m or rad]; above 0, as weights must be finite."""
    if drive.distance is not None:
        return max(ruler.distance_mm, 1e-3) / 1e3
    return math.radians(max(ruler.bearing_deg, 1e-3))
