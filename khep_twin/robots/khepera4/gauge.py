"""Battery of the Khepera IV, two lithium polymer cells of 3400 mAh, and its gauge.

The robot stops at 6.0 V (manual). The charge of a battery without a time of use stays constant.
"""

from khep_twin.board.lithium_cells import cells_voltage, charge_level
from khep_twin.board.memory import write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.sensing.buffers import Vector
from khep_twin.units import TICK_NS

CAPACITY, FULL_MIN = 3.4 * 3600, 300
"""Charge of a full battery [C], and its time of use with the motors on [min] (manual)."""

CUT_OFF = 6.0
"""Voltage at which the robot stops [V] (manual)."""

CURRENT_TICKS, AVERAGE_TICKS = 350, 2800
"""Control periods over which the gauge takes its current, 3.5 s, and its average, 28 s (manual)."""

_CURRENT_UNIT, _CHARGE_UNIT, _VOLTAGE_UNIT, _DEGREE_UNIT = 78.125e-6, 1.6e-3 * 3600, 9.76e-3, 0.003906
"""Units of the registers [A, C, V, degree Celsius] (manual). The gauge has its voltage in the upper 11 bits;
the dsPIC returns a plain number, as all public programs expect."""

_TEMPERATURE = 25.0
"""Temperature (assumed)."""


USED, SUM, TICKS, CURRENT, AVERAGE = range(5)
"""Indices in the state of a gauge: used charge [C], sum of currents [A] and number of control periods since
the last measured current, that current, and its average [A]."""
N_GAUGE = 5

_BATTERY = int(DspicRegister.BATTERY)


@compilable
def battery_voltage(gauge: Vector[float]) -> float:
    """Return the present voltage [V]."""
    return cells_voltage(charge_level(gauge[USED], CAPACITY))


@compilable
def draw_current(gauge: Vector[float], is_discharged: int, current: float) -> bool:
    """Draw a current [A] for a control period; return whether the gauge has a new value."""
    if is_discharged:
        gauge[USED] = min(gauge[USED] + current * TICK_NS * 1e-9, CAPACITY)
    gauge[SUM] += current
    gauge[TICKS] += 1
    if gauge[TICKS] < CURRENT_TICKS:
        return False
    gauge[CURRENT] = gauge[SUM] / gauge[TICKS]
    gauge[AVERAGE] += (gauge[CURRENT] - gauge[AVERAGE]) * CURRENT_TICKS / AVERAGE_TICKS
    gauge[SUM] = gauge[TICKS] = 0.0
    return True


@compilable
def write_block(memory: Vector[int], gauge: Vector[float]) -> None:
    """Set the registers of the gauge in a dsPIC's memory (12 bytes): its status, and its values."""
    level = charge_level(gauge[USED], CAPACITY)
    memory[_BATTERY] = 0
    write_number(memory, _BATTERY + 1, 2, round(level * CAPACITY / _CHARGE_UNIT))
    write_number(memory, _BATTERY + 3, 1, round(100 * level))
    write_number(memory, _BATTERY + 4, 2, round(-gauge[CURRENT] / _CURRENT_UNIT))
    write_number(memory, _BATTERY + 6, 2, round(-gauge[AVERAGE] / _CURRENT_UNIT))
    write_number(memory, _BATTERY + 8, 2, round(_TEMPERATURE / _DEGREE_UNIT) & ~0x1F)
    write_number(memory, _BATTERY + 10, 2, round(battery_voltage(gauge) / _VOLTAGE_UNIT))
