"""Measurements of a Khepera IV: moments of its sensors, their evaluation, and the registers of a log.

Infrared sensors record a moment every 5 ms, an enabled ultrasonic one every 20 ms. A moment is evaluated when
its readings are read. The functions are `compilable`, see `robots.core`.
"""

from collections.abc import Collection, Sequence

from khep_twin.board.memory import read_signed, write_number
from khep_twin.compilable import compilable
from khep_twin.robots.khepera4 import ultrasonic
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC
from khep_twin.robots.khepera4.inertial import PACKET_SIZE
from khep_twin.robots.khepera4.model import SAMPLED
from khep_twin.robots.khepera4.motor_control import LEFT_PWM, RIGHT_PWM
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.robots.khepera4.state import Khepera4State
from khep_twin.sensing import sonar
from khep_twin.sensing.bursts import ECHO, INFRARED, NONE, RobotState, record_scan, start_burst
from khep_twin.sensing.device_faults import sensor_reading, set_reading
from khep_twin.sensing.ground import convert_any
from khep_twin.sensing.noise import draws
from khep_twin.sensing.scene import BeamScene, update_frames
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row

WORDS = (
    (int(DspicRegister.PROXIMITY), 2, 0, 2, N_INFRARED),
    (int(DspicRegister.AMBIENT), 2, 0, 2, N_INFRARED),
    (int(DspicRegister.ULTRASONIC), 2, 0, 2, N_ULTRASONIC),
    (int(DspicRegister.SPEED_LEFT), 2, 1, 2, 2),
    (int(DspicRegister.SPEED_ORDER_LEFT), 2, 1, 2, 2),
    (int(DspicRegister.POSITION_LEFT), 4, 1, 4, 2),
    (int(DspicRegister.POSITION_ORDER_LEFT), 4, 1, 4, 2),
    (0, 1, 0, 0, 2),  # places of both PWM, which are not in the memory
    (int(DspicRegister.LEDS), 1, 0, 1, 9),
    (int(DspicRegister.ACCELEROMETER), 2, 1, 2 * PACKET_SIZE, 3),
    (int(DspicRegister.GYROSCOPE), 2, 1, 2 * PACKET_SIZE, 3),
    (int(DspicRegister.BATTERY) + 10, 2, 0, 2, 1),  # voltage
    (int(DspicRegister.BATTERY) + 4, 2, 1, 2, 1),  # current
    (int(DspicRegister.BATTERY) + 1, 2, 0, 2, 1),  # charge
    (int(DspicRegister.BATTERY) + 8, 2, 1, 2, 1),  # temperature
    (int(DspicRegister.CONTROL), 1, 0, 1, 1),
    (int(DspicRegister.ON_TARGET), 1, 0, 1, 1),
    (int(DspicRegister.ULTRASONIC_ENABLED), 1, 0, 1, 1),
    (int(DspicRegister.STATUS_LED), 1, 0, 1, 1),
)
"""Numbers of the dsPIC's memory in the order of `CHANNELS`: first byte, size, 1 if signed, distance from one
to the next [bytes], and their number."""

INFRARED_NS = 5_000_000
"""Period of the infrared sensors [ns] (manual)."""

(_DUTY,) = (channel.registers[0] for channel in SAMPLED if channel.name == "duty")
_PROXIMITY, _AMBIENT = int(DspicRegister.PROXIMITY), int(DspicRegister.AMBIENT)
_ENABLED, _ULTRASONIC_WORDS = int(DspicRegister.ULTRASONIC_ENABLED), int(DspicRegister.ULTRASONIC)


@compilable
def sense(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Record the moments of a step, if any are due."""
    time_ns = simulated.counters[STEPS] * simulated.timing.step_ns
    if start >= 0 and time_ns % INFRARED_NS == 0:
        record(robot, simulated, inputs, time_ns)


@compilable
def record(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, time_ns: int) -> None:
    """Record the moments that are due at a time [ns]."""
    record_scan(robot, simulated, inputs, time_ns)
    if time_ns % ultrasonic.PERIOD_NS:
        return
    last = robot.burst[0]
    if robot.is_eager[0] and last != NONE:
        _set_distance(robot, last, robot.burst_distance[0])
    if start_burst(robot, simulated, inputs, time_ns, robot.dspic.memory[_ENABLED]):
        sensor, scene = robot.burst[0], simulated.scene
        robot.burst_distance[0] = _measure_distance(robot, scene, inputs, sensor, time_ns)


@compilable
def evaluate(robot: Khepera4State, simulated: Simulated, inputs: StepInputs, part: int) -> None:
    """Evaluate the moment INFRARED, or that of an ultrasonic sensor from ECHO on."""
    if part == INFRARED:
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[0])
    else:
        sensor, scene, time_ns = part - ECHO, simulated.scene, robot.times[part]
        _set_distance(robot, sensor, _measure_distance(robot, scene, inputs, sensor, time_ns))
        robot.times[part] = NONE


@compilable
def update_registers(robot: Khepera4State, simulated: Simulated, inputs: StepInputs) -> None:
    """Evaluate the infrared sensors, whose moment is the present, and set the registers."""
    if robot.times[INFRARED] != NONE:
        update_frames(simulated.scene)
        _evaluate_infrared(robot, simulated, inputs, inputs.powers[powers_row(simulated, inputs)])
    for sensor in range(N_ULTRASONIC):
        is_enabled = robot.dspic.memory[_ENABLED] >> sensor & 1 and robot.is_eager[0]
        distance = robot.distances[sensor] if is_enabled else ultrasonic.DISABLED
        write_number(robot.dspic.memory, _ULTRASONIC_WORDS + 2 * sensor, 2, distance)
    fill_registers(robot)


@compilable
def fill_registers(robot: Khepera4State) -> None:
    """Set the registers to the numbers of the dsPIC."""
    index, registers, memory = 0, robot.registers, robot.dspic.memory
    for first, size, is_signed, stride, count in WORDS:
        for number in range(count):
            value = read_signed(memory, first + number * stride, size)
            registers[index] = value if is_signed or value >= 0 else value + (1 << 8 * size)
            index += 1
    registers[_DUTY] = robot.dspic.motors[LEFT_PWM]
    registers[_DUTY + 1] = robot.dspic.motors[RIGHT_PWM]


def request_terms(state: RobotState, names: Collection[str]) -> None:
    """Evaluate each burst immediately if the ultrasonic sensors are among the terms."""
    state["is_eager"] = "ultrasonic" in names


@compilable
def _set_distance(robot: Khepera4State, sensor: int, distance: int) -> None:
    """Set the reading of an ultrasonic sensor; a dead one receives no echo (assumed)."""
    number, silence = N_INFRARED + sensor, ultrasonic.NO_ECHO
    set_reading(robot.distances, sensor, robot.faults, number, distance, silence)


@compilable
def _measure_distance(
    robot: Khepera4State, scene: BeamScene, inputs: StepInputs, sensor: int, time_ns: int
) -> int:
    """Return the reading of an ultrasonic sensor in a scene at its burst."""
    distance = sonar.cast(scene, robot.sensors, robot.pose, robot.sonar, robot.beams, sensor, 0)
    number = time_ns // ultrasonic.PERIOD_NS
    return sonar.reading_of(robot.sonar, distance, inputs.tables, robot.noise, number)


@compilable
def _evaluate_infrared(
    robot: Khepera4State, simulated: Simulated, inputs: StepInputs, powers: Sequence[float]
) -> None:
    """Set the registers of the infrared sensors by a scene at their moment."""
    scene, ground, memory, time_ns = simulated.scene, robot.ground, robot.dspic.memory, robot.times[INFRARED]
    for channel in range(N_INFRARED):
        random = draws(inputs.tables, robot.noise, time_ns // INFRARED_NS * N_INFRARED + channel)
        reflected, ambient = convert_any(
            scene, robot.sensors, ground, simulated.light, powers, time_ns, channel, random
        )
        for word, reading, dead in ((_PROXIMITY, reflected, 0), (_AMBIENT, ambient, ground.darkest)):
            start = word + 2 * channel
            last = read_signed(memory, start, 2)
            reading = sensor_reading(robot.faults, channel, reading, last, dead)
            write_number(memory, start, 2, reading)
    robot.times[INFRARED] = NONE
