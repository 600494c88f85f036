"""Supply of the robot: the charger, or four NiCd cells with the discharge curve of the manual's figure 14."""

from khep_twin.compilable import compilable
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
"""Minutes of use and voltage of the cells [min, V], with linear interpolation (fitted to the manual's figure
14; the residual of 0.035 V rms is the noise of the figure). The load has no influence."""

_NS_PER_MIN = 60_000_000_000

CHARGER = -1.0
"""Value of the minutes of use for a robot on the charger, whose voltage is constant."""


@compilable
def voltage(used_min: float, time_ns: int) -> float:
    """Return the supply voltage at a time of the run [V].

    Args:
        used_min: Use of the cells before the run [min], or CHARGER.
        time_ns: Time of the run [ns].
    """
    if used_min < 0:
        return SUPPLY_VOLTAGE
    return cell_voltage(used_min + time_ns / _NS_PER_MIN)


@compilable
def cell_voltage(used_min: float) -> float:
    """Return the voltage of the cells after some minutes of use [V]."""
    for index in range(1, len(DISCHARGE)):
        (start_min, start), (end_min, end) = DISCHARGE[index - 1], DISCHARGE[index]
        if used_min < end_min:
            return start + (end - start) * (used_min - start_min) / (end_min - start_min)
    return DISCHARGE[-1][1]
