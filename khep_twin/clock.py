"""Time: an integer in nanoseconds, advanced in whole steps; and the pacer that ties it to the wall clock."""

import time

NS_PER_S = 1_000_000_000


def n_steps(duration_ns: int, step_ns: int) -> int:
    """How many whole steps a duration has.

    Raises:
        ValueError: the duration is no whole number of steps.
    """
    if step_ns <= 0 or duration_ns % step_ns:
        raise ValueError(f"{duration_ns} ns is not a whole number of steps of {step_ns} ns")
    return duration_ns // step_ns


def to_ns(duration: float) -> int:
    """Seconds [s] as integer nanoseconds [ns], rounded to the nearest."""
    return round(duration * NS_PER_S)


class Pacer:
    """Simulated time against the wall clock, by absolute deadlines.

    Simulated time t is due at `start + (t - origin) / speed`, so rounding never adds up. A loop that falls
    further behind than the tolerance slips: the origin moves, the slip is counted, and nothing of it is made
    up for by sprinting. What is within the tolerance is made up for.

    Attributes:
        slips: how often the loop fell behind.
        slipped_ns: how much wall time was given up in all [ns].
    """

    def __init__(self, speed: float, time_ns: int, tolerance_ns: int = 50_000_000) -> None:
        if not speed > 0:
            raise ValueError(f"speed {speed} must be above 0")
        self.speed = speed
        self.slips = 0
        self.slipped_ns = 0
        self._tolerance_ns = tolerance_ns
        self._wall_ns = time.monotonic_ns()
        self._time_ns = time_ns

    def due_ns(self) -> int:
        """The simulated time that is due now [ns]."""
        return self._time_ns + round((time.monotonic_ns() - self._wall_ns) * self.speed)

    def wait(self, time_ns: int) -> float:
        """How long until simulated `time_ns` is due [s of wall time]; 0 or less when it is overdue."""
        return ((time_ns - self._time_ns) / self.speed - (time.monotonic_ns() - self._wall_ns)) / NS_PER_S

    def wall_ns(self, time_ns: int) -> int:
        """When simulated `time_ns` is due on the wall clock, `time.monotonic_ns` [ns]."""
        return self._wall_ns + round((time_ns - self._time_ns) / self.speed)

    def slip(self, time_ns: int) -> int:
        """Tell that the loop has reached `time_ns`; returns the wall time given up, 0 if in time [ns]."""
        late_ns = -round(self.wait(time_ns) * NS_PER_S)
        if late_ns <= self._tolerance_ns:
            return 0
        self._wall_ns += late_ns
        self.slips += 1
        self.slipped_ns += late_ns
        return late_ns
