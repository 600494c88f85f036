"""Time: an integer in nanoseconds, advanced in whole steps; its sources, and the pacer for the wall clock."""

import time
from typing import Protocol

NS_PER_S = 1_000_000_000

NEVER_NS = 1 << 62
"""Time of an event that never happens [ns]."""


def n_steps(duration_ns: int, step_ns: int) -> int:
    """Return the number of whole steps in a duration.

    Raises:
        ValueError: The duration is not a whole number of steps.
    """
    if step_ns <= 0 or duration_ns % step_ns:
        raise ValueError(f"{duration_ns} ns is not a whole number of steps of {step_ns} ns")
    return duration_ns // step_ns


def to_ns(duration: float) -> int:
    """Convert seconds [s] to integer nanoseconds [ns], rounded to the nearest.

    Raises:
        ValueError: The duration is not a number, or more than 146 years.
    """
    if not abs(duration) < NEVER_NS / NS_PER_S:
        raise ValueError(f"{duration:g} s; expected less than {NEVER_NS / NS_PER_S:.3g} s")
    return round(duration * NS_PER_S)


class TimeSource(Protocol):
    """Passage of simulated time for a program on a line: unpaced, paced, or in turn with other programs."""

    def advance_to(self, time_ns: int) -> None:
        """Return when simulated time has reached `time_ns` [ns]."""

    def attend(self) -> None:
        """Handle other pending events before the program's next bytes."""


class Pacer:
    """Pacer of simulated time at `speed` simulated seconds per real second, with absolute deadlines.

    Simulated time t is due at `start + (t - origin) / speed`, so rounding errors do not add up. A loop that
    falls further behind than the tolerance slips: the origin moves, and the delay is not caught up.

    Attributes:
        slips: Number of slips.
        slipped_ns: Sum of all slips in wall time [ns].
    """

    def __init__(self, speed: float, time_ns: int, tolerance_ns: int = 50_000_000) -> None:
        if not speed > 0:
            raise ValueError(f"speed = {speed}; expected a number above 0")
        self.speed = speed
        self.slips = 0
        self.slipped_ns = 0
        self._tolerance_ns = tolerance_ns
        self._origin_wall_ns = time.monotonic_ns()
        self._origin_ns = time_ns

    def due_ns(self) -> int:
        """Return the simulated time that is due now [ns]."""
        return self._origin_ns + round((time.monotonic_ns() - self._origin_wall_ns) * self.speed)

    def wait_s(self, time_ns: int) -> float:
        """Return the wall time until simulated `time_ns` is due [s]; 0 or less when it is overdue."""
        elapsed_ns = time.monotonic_ns() - self._origin_wall_ns
        return ((time_ns - self._origin_ns) / self.speed - elapsed_ns) / NS_PER_S

    def slip(self, time_ns: int) -> int:
        """Record that the loop has reached `time_ns`; return the slip in wall time, 0 if in time [ns]."""
        late_ns = -round(self.wait_s(time_ns) * NS_PER_S)
        if late_ns <= self._tolerance_ns:
            return 0
        self._origin_wall_ns += late_ns
        self.slips += 1
        self.slipped_ns += late_ns
        return late_ns
