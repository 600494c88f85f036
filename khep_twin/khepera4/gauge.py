"""Battery of the Khepera IV, two lithium polymer cells of 3400 mAh, and its gauge.

The voltage is piecewise linear in the charge (assumed: typical of these cells) and independent of the load;
the robot stops at 6.0 V (manual). The charge of a battery without a time of use stays constant.
"""

from itertools import pairwise

from khep_twin.simulation.number_reader import NumberReader
from khep_twin.units import TICK_NS

CAPACITY = 3.4 * 3600
"""Charge of a full battery [C] (manual)."""

VOLTAGES = ((0.0, 6.0), (0.05, 6.9), (0.2, 7.3), (0.6, 7.6), (1.0, 8.2))
"""Remaining part of the charge, and voltage [V]."""

CUT_OFF = 6.0
"""Voltage at which the robot stops [V] (manual)."""

CURRENT_TICKS, AVERAGE_TICKS = 350, 2800
"""Control periods over which the gauge takes its current, 3.5 s, and its average, 28 s (manual)."""

_CURRENT_UNIT, _CHARGE_UNIT, _VOLTAGE_UNIT, _DEGREE_UNIT = 78.125e-6, 1.6e-3 * 3600, 9.76e-3, 0.003906
"""Units of the registers [A, C, V, degree Celsius] (manual). The gauge has its voltage in the upper 11 bits;
the dsPIC returns a plain number, as all public programs expect."""

_TEMPERATURE = 25.0
"""Temperature (assumed)."""


class Gauge:
    """Battery and gauge.

    Args:
        used_min: Minutes of use with the motors on, of 300 for a full charge; None for a full battery that is
            not discharged.
    """

    def __init__(self, used_min: float | None) -> None:
        self._is_discharged = used_min is not None
        self._used_charge = CAPACITY * min((used_min or 0.0) / 300, 1)
        self._current_sum = self._ticks = 0.0
        self._current = self._average_current = 0.0

    @property
    def voltage(self) -> float:
        """Present voltage [V]."""
        level = self.level
        for (low_level, low_v), (high_level, high_v) in pairwise(VOLTAGES):
            if level <= high_level:
                return low_v + (high_v - low_v) * (level - low_level) / (high_level - low_level)
        return VOLTAGES[-1][1]

    @property
    def level(self) -> float:
        """Remaining part of the charge, 0 to 1."""
        return 1 - self._used_charge / CAPACITY

    def tick(self, current: float) -> bool:
        """Draw a current [A] for a control period; return whether the gauge has a new value."""
        if self._is_discharged:
            self._used_charge = min(self._used_charge + current * TICK_NS * 1e-9, CAPACITY)
        self._current_sum += current
        self._ticks += 1
        if self._ticks < CURRENT_TICKS:
            return False
        self._current = self._current_sum / self._ticks
        self._average_current += (self._current - self._average_current) * CURRENT_TICKS / AVERAGE_TICKS
        self._current_sum = self._ticks = 0.0
        return True

    @property
    def block(self) -> bytes:
        """Registers of the gauge (12 bytes, little-endian)."""
        values = (
            (round(self.level * CAPACITY / _CHARGE_UNIT), 2),
            (round(100 * self.level), 1),
            (round(-self._current / _CURRENT_UNIT), 2),
            (round(-self._average_current / _CURRENT_UNIT), 2),
            (round(_TEMPERATURE / _DEGREE_UNIT) & ~0x1F, 2),
            (round(self.voltage / _VOLTAGE_UNIT), 2),
        )
        registers = b"".join((value & (1 << 8 * size) - 1).to_bytes(size, "little") for value, size in values)
        return b"\0" + registers

    def state(self) -> list[float]:
        """Return the state."""
        return [self._used_charge, self._current_sum, self._ticks, self._current, self._average_current]

    def set_state(self, floats: NumberReader[float]) -> None:
        """Restore a state.

        Raises:
            ValueError: It has fewer numbers, or one is outside its range.
        """
        (self._used_charge,) = floats.take("used charge", 1, 0, CAPACITY)
        (self._current_sum,) = floats.take("sum of currents", 1)
        (self._ticks,) = floats.take("control periods of the sum", 1, 0, CURRENT_TICKS - 1)
        self._current, self._average_current = floats.take("measured currents", 2)
