"""The robot's supply: the charger, or four NiCd cells that run down as in the manual's figure 14."""

from bisect import bisect_right

from khep_twin.units import SUPPLY_VOLTAGE

DISCHARGE = (
    (0.0, 5.43),
    (0.3, 5.24),
    (4.4, 4.99),
    (9.7, 4.83),
    (25.9, 4.69),
    (35.9, 4.50),
    (40.2, 4.26),
    (41.3, 3.89),
    (42.1, 3.32),
    (45.0, 3.31),
)
"""Minutes of use and voltage of the cells [min, V]; straight lines between them (fitted to the manual's
figure 14, rms 0.035 V, the noise of the figure). The load has no influence."""

_NS_PER_MIN = 60_000_000_000


class Supply:
    """Supply of one robot.

    Args:
        battery_used_min: Use of the cells before the run [min]; None for the charger.

    Attributes:
        steady: True if the voltage never changes.
    """

    def __init__(self, battery_used_min: float | None) -> None:
        self._used_min = battery_used_min
        self.steady = battery_used_min is None

    def voltage(self, time_ns: int) -> float:
        """Return the supply voltage at a time of the run [V]."""
        if self._used_min is None:
            return SUPPLY_VOLTAGE
        return discharged(self._used_min + time_ns / _NS_PER_MIN)


def discharged(used_min: float) -> float:
    """Return the voltage of the cells after so many minutes of use [V]."""
    index = bisect_right(DISCHARGE, (used_min, float("inf")))
    if index == len(DISCHARGE):
        return DISCHARGE[-1][1]
    (start_min, start), (end_min, end) = DISCHARGE[index - 1], DISCHARGE[index]
    return start + (end - start) * (used_min - start_min) / (end_min - start_min)
