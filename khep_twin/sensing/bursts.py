"""Moments of a robot whose infrared sensors convert together, and whose ultrasonic sensors take turns.

A moment is recorded in the step, and evaluated when its readings are read; eager robots evaluate a burst at
once. The robot's state has `first_moment`, `times` [ns], `burst` (last sensor, (1,)) and `is_eager` (1,). The
functions are `compilable`.
"""

from typing import Any

from khep_twin.compilable import compilable
from khep_twin.sensing.scene import copy_moment, save_moment, update_frames
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row

RobotState = Any
"""State of a robot: a named tuple of a class in `robots.core.CORES`, or its record in compiled code."""

INFRARED, BURST, ECHO = 0, 1, 2
"""Moments of a robot: of its infrared sensors, of the last burst, and of the last complete burst of each
ultrasonic sensor, from ECHO on."""

NONE = -1
"""No time of a moment; no ultrasonic sensor."""

_BOARD, _SENSING = ("kernel", "memory", "lithium_cells"), ("bursts", "ground", "sonar")
MODULES = *(f"khep_twin.board.{name}" for name in _BOARD), *(f"khep_twin.sensing.{name}" for name in _SENSING)
"""Modules that the cores of these robots compile besides their own."""


def scan(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure with all infrared sensors now."""
    save_moment(simulated.scene, robot.first_moment + INFRARED, inputs.powers[0])
    robot.times[INFRARED] = simulated.counters[STEPS] * simulated.timing.step_ns


@compilable
def record_scan(robot: RobotState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> None:
    """Record the moment of the infrared sensors."""
    powers = inputs.powers[powers_row(simulated, inputs)]
    save_moment(simulated.scene, robot.first_moment + INFRARED, powers)
    robot.times[INFRARED] = time_ns


@compilable
def start_burst(
    robot: RobotState, simulated: Simulated, inputs: StepInputs, time_ns: int, active_mask: int
) -> bool:
    """End the last burst and start that of the next active sensor; return True if it is evaluated now."""
    scene, first, times, last = simulated.scene, robot.first_moment, robot.times, robot.burst[0]
    if last != NONE and not robot.is_eager[0]:
        copy_moment(scene, first + BURST, first + ECHO + last)
        times[ECHO + last] = times[BURST]
    sensor = robot.burst[0] = _next_sensor(last, active_mask, len(times) - ECHO)
    if sensor == NONE:
        return False
    times[BURST] = time_ns
    if robot.is_eager[0]:
        update_frames(scene)
        return True
    save_moment(scene, first + BURST, inputs.powers[powers_row(simulated, inputs)])
    return False


@compilable
def _next_sensor(last: int, active_mask: int, n_sensors: int) -> int:
    """Return the active ultrasonic sensor after the last one, or NONE."""
    for offset in range(1, n_sensors + 1):
        sensor = (last + offset) % n_sensors
        if active_mask >> sensor & 1:
            return sensor
    return NONE
