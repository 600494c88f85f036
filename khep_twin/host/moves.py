"""Moves that wait until they are done: along a straight path, on the spot, to a target.

The wheels follow the board's own trapezoid (command J), and the board reports the arrival (command K).
"""

import math
from typing import Protocol

from khep_twin.errors import MoveError
from khep_twin.host.results import MotionStatus, MotorMode, Positions
from khep_twin.units import PULSE_LENGTH, WHEEL_BASE

LONGEST_WAY_PULSES = 2**23 - 2
"""Farthest target of command C (manual, appendix A)."""

_PAUSE = 0.05
"""Pause between two reads of the wheels [s]."""


class MovingRobot(Protocol):
    """Interface of a robot to its moves, as `Khepera` has it."""

    name: str

    @property
    def time(self) -> float:
        """Time on the robot's port [s]."""
        ...

    def position(self) -> Positions:
        """Read both counters."""
        ...

    def status(self) -> MotionStatus:
        """Read the state of both wheels."""
        ...

    def set_target(self, left: int, right: int) -> None:
        """Move both wheels to these counters."""
        ...

    def set_speed(self, left: int, right: int) -> None:
        """Set both speeds [pulses/10 ms]."""
        ...

    def sleep(self, duration: float) -> None:
        """Wait for a time on the port [s]."""
        ...


def way_pulses(distance: float) -> int:
    """Return the pulses of both wheels along a straight path [m]."""
    return round(_finite("distance", distance) / PULSE_LENGTH)


def turn_pulses(angle: float, wheel_base: float = WHEEL_BASE) -> int:
    """Return the pulses of the right wheel, minus those of the left, for a turn on the spot [rad].

    pulses = angle * wheel_base / 2 / PULSE_LENGTH
    """
    return round(_finite("angle", angle) * wheel_base / 2 / PULSE_LENGTH)


def drive_by(robot: MovingRobot, left: int, right: int, timeout: float) -> Positions:
    """Move the wheels on by so many pulses and wait; see `Khepera.move`."""
    start = robot.position()
    target = start.left + left, start.right + right
    if max(map(abs, target)) > LONGEST_WAY_PULSES:
        raise MoveError(
            f"{robot.name}: from counters {tuple(start)} to {target} pulses; "
            f"expected a target within {LONGEST_WAY_PULSES} of 0"
        )
    robot.set_target(*target)
    try:
        wait_for_target(robot, timeout)
    except MoveError as error:
        robot.set_speed(0, 0)
        now = robot.position()
        raise MoveError(f"{error}; stopped at {tuple(now)} of {target} pulses") from None
    return robot.position()


def wait_for_target(robot: MovingRobot, timeout: float) -> None:
    """Wait until both wheels are on target; see `Khepera.wait_for_target`."""
    end = robot.time + timeout
    while not (status := robot.status()).on_target:
        moving = [
            (name, wheel)
            for name, wheel in zip(("left", "right"), status, strict=True)
            if not wheel.on_target
        ]
        for name, wheel in moving:
            if wheel.mode != MotorMode.POSITION:
                raise MoveError(
                    f"{robot.name}: the {name} wheel goes to no target but is in {wheel.mode.name} mode; "
                    "expected set_target before"
                )
        if not robot.time <= end:
            names = " and ".join(name for name, _ in moving)
            raise MoveError(f"{robot.name}: not on target after {timeout:g} s ({names} wheel)")
        robot.sleep(_PAUSE)


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ValueError(f"{name} = {value}; expected a finite number")
    return value
