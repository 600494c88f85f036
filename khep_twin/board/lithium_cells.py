"""Battery of two lithium polymer cells.

The voltage is piecewise linear in the charge (assumed: typical of these cells) and independent of the load.
"""

from khep_twin.compilable import compilable

VOLTAGES = ((0.0, 6.0), (0.05, 6.9), (0.2, 7.3), (0.6, 7.6), (1.0, 8.2))
"""Remaining part of the charge, and voltage [V]."""


def used_charge(capacity: float, used_min: float | None, full_min: float) -> float:
    """Return the charge used before the run [C], by minutes of use with the motors on, `full_min` for all."""
    return capacity * min((used_min or 0.0) / full_min, 1)


@compilable
def charge_level(used: float, capacity: float) -> float:
    """Return the remaining part of the charge, 0 to 1, by the used charge and that of a full battery [C]."""
    return 1 - used / capacity


@compilable
def cells_voltage(level: float) -> float:
    """Return the voltage [V] by the remaining part of the charge."""
    for index in range(1, len(VOLTAGES)):
        (low_level, low), (high_level, high) = VOLTAGES[index - 1], VOLTAGES[index]
        if level <= high_level:
            return low + (high - low) * (level - low_level) / (high_level - low_level)
    return VOLTAGES[-1][1]
