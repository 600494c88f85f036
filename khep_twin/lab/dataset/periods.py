"""Control periods of a logged robot, from the samples of a twin or the replies of a real robot."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError

MIN_PERIOD_NS = 20_000_000
"""Shortest control period of a dataset [ns]: the sample period of a twin's log."""


@dataclass(frozen=True, slots=True)
class Periods:
    """Consecutive control periods of one robot: its states at their borders, and the commanded speeds.

    Attributes:
        period_ns: Control period [ns].
        times_ns: Times of the borders in the log (n + 1,) [ns].
        registers: Registers of the board at the borders (n + 1, N_REGISTERS); 0 where unknown.
        speeds: Speeds of left and right wheel at the borders (n + 1, 2) [pulses/10 ms].
        commanded: Commanded speeds in the middle of each period (n, 2) [pulses/10 ms].
        poses: True x, y [m] and heading [rad] at the borders (n + 1, 3); None if the log has none.
        is_complete: Whether a period is known, with the wheels in speed mode (n,).
        dark: Ambient reading in the dark [counts].
        floor: Ambient reading in the brightest light [counts].
        goal: Position x, y of the task's goal [m].
    """

    period_ns: int
    times_ns: NDArray[np.int64]
    registers: NDArray[np.int64]
    speeds: NDArray[np.float64]
    commanded: NDArray[np.float64]
    poses: NDArray[np.float64] | None
    is_complete: NDArray[np.bool_]
    dark: float
    floor: float
    goal: tuple[float, float] = (0.0, 0.0)

    def stretches(self, max_length: int) -> list[tuple[int, int]]:
        """Return the first and last border of each stretch of at most `max_length` complete periods."""
        edges = np.flatnonzero(np.diff(self.is_complete, prepend=False, append=False)).tolist()
        return [
            (start, min(start + max_length, end))
            for begin, end in zip(edges[::2], edges[1::2], strict=True)
            for start in range(begin, end, max_length)
        ]


def check_period(period_ns: int, limit_ns: int) -> None:
    """Check a control period.

    Raises:
        LogError: It is not a multiple of 10 ms, below 20 ms, or does not divide the time limit.
    """
    if period_ns < MIN_PERIOD_NS or period_ns % 10_000_000 or limit_ns % period_ns:
        raise LogError(
            f"control period of {period_ns / 1e6:g} ms; expected whole ticks of 10 ms, 20 ms or more, that "
            f"divide the task's time limit of {limit_ns / 1e9:g} s"
        )
