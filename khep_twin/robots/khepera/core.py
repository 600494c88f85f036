"""Core of the Khepera and the Khepera II: sensors, control tick and supply of a robot.

A step converts the next sensor, a control tick runs from encoders to motor voltages. The functions are
`compilable`, see `robots.core`.
"""

from typing import cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import battery, kernel
from khep_twin.board.rom import DEMO, ROMS
from khep_twin.compilable import compilable
from khep_twin.firmware import SPEED_LIMIT_PULSES, TARGET_LIMIT_PULSES, Firmware
from khep_twin.playpen import RobotEntry
from khep_twin.robots.core import Core, register
from khep_twin.robots.khepera.model import KHEPERA_1
from khep_twin.sensing.buffers import Vector, state_class
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.device_faults import drive_motor, sensor_reading
from khep_twin.sensing.noise import draws
from khep_twin.sensing.optics import convert
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import Scene, joint_position, motor_torque
from khep_twin.sensing.simulated import N_CONVERSIONS, STEPS, Simulated, StepInputs, powers_row
from khep_twin.sensors import RobotFields, core_fields

_PROXIMITY, _AMBIENT = int(kernel.Board.PROXIMITY), int(kernel.Board.AMBIENT)
_LEFT_DUTY, _RIGHT_DUTY = kernel.DUTIES
_D, _P, _C = map(ord, "DPC")
_LEFT_ENCODER, _RIGHT_ENCODER = int(kernel.Wheel.ENCODER), kernel.RIGHT + int(kernel.Wheel.ENCODER)


@state_class
class KheperaState(RobotFields):
    """State of one robot.

    Attributes (see also `RobotFields`):
        idle_current: Supply current with the motors at rest [A].
        used_min: Use of the cells before the run [min]; or `battery.CHARGER`.
        registers: State of the board (N_REGISTERS,).
        processor: State of the processor (N_PROCESSOR,).
        voltage: Last measured supply voltage (1,) [V].
    """

    idle_current: float
    used_min: float
    registers: kernel.Registers
    processor: Vector[int]
    voltage: Vector[float]


def _make_state(
    model: mujoco.MjModel, indices: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> KheperaState:
    registers = np.zeros(kernel.N_REGISTERS, np.int64)
    kernel.reset(registers.data)
    is_demo = ROMS[entry.rom].modes[entry.mode].function == DEMO
    return KheperaState(
        **core_fields(model, indices, measured, entry, first_moment),
        idle_current=entry.body.idle_current,
        used_min=battery.CHARGER if entry.battery_used_min is None else entry.battery_used_min,
        registers=cast(Vector[int], registers),
        processor=np.array([1, is_demo], np.int64),
        voltage=np.zeros(1),
    )


@compilable
def _sense(robot: KheperaState, simulated: Simulated, inputs: StepInputs, start: int) -> None:
    """Convert the sensors of a step."""
    row, number = powers_row(simulated, inputs), simulated.counters[N_CONVERSIONS]
    for offset in range(simulated.timing.conversions):
        time_ns, channel = (start + offset) * units.STEP_NS, (start + offset) % units.N_SENSORS
        convert_sensor(robot, simulated, inputs, row, time_ns, channel, number + offset)


@compilable
def convert_sensor(
    robot: KheperaState,
    simulated: Simulated,
    inputs: StepInputs,
    row: int,
    time_ns: int,
    channel: int,
    number: int,
) -> None:
    """Convert one sensor of a robot.

    Args:
        robot: State of the robot.
        simulated: Scene, robots and lamps.
        inputs: Lamps and random draws.
        row: Row of the lamps' powers.
        time_ns: Time of the conversion [ns].
        channel: Number of the sensor.
        number: Number of the conversion, which indexes its random draws.
    """
    registers, faults, ceiling = robot.registers, robot.faults, robot.sensors.ambient.ceiling
    noise = draws(inputs.tables, robot.noise, number)
    proximity, ambient = convert(
        simulated.scene, robot.sensors, simulated.light, inputs.powers[row], time_ns, channel, noise
    )
    proximity = sensor_reading(faults, channel, proximity, registers[_PROXIMITY + channel], 0)
    ambient = sensor_reading(faults, channel, ambient, registers[_AMBIENT + channel], ceiling)
    kernel.convert(registers, proximity, ambient)


def _scan(robot: KheperaState, simulated: Simulated, inputs: StepInputs) -> None:
    """Convert all sensors now, starting with that of the next step."""
    steps, number = simulated.counters[STEPS], simulated.counters[N_CONVERSIONS]
    for offset in range(units.N_SENSORS):
        channel = (steps + offset) % units.N_SENSORS
        time_ns = steps * simulated.timing.step_ns
        convert_sensor(robot, simulated, inputs, 0, time_ns, channel, number + offset)


@compilable
def _start(robot: KheperaState, simulated: Simulated, inputs: StepInputs) -> bool:
    """Set the encoders to the wheels' present angles, and measure the supply."""
    scene = simulated.scene
    robot.registers[_LEFT_ENCODER] = units.wheel_pulses(joint_position(scene, robot.angles[0]))
    robot.registers[_RIGHT_ENCODER] = units.wheel_pulses(joint_position(scene, robot.angles[1]))
    return _measure_supply(robot, simulated, 0)


@compilable
def _measure_supply(robot: KheperaState, simulated: Simulated, time_ns: int) -> bool:
    """Measure the supply; return True if its voltage is low, which resets and stops the processor."""
    registers, scene = robot.registers, simulated.scene
    left, right = registers[_LEFT_DUTY], registers[_RIGHT_DUTY]
    robot.voltage[0] = voltage = battery.voltage(robot.used_min, time_ns)
    current = robot.idle_current
    current += units.supply_current(left, motor_torque(scene, robot.motors[0]) / robot.motor_constant)
    current += units.supply_current(right, motor_torque(scene, robot.motors[1]) / robot.motor_constant)
    kernel.measure(registers, units.supply_counts(voltage), round(current * 1000))
    if voltage >= units.PROCESSOR_VOLTAGE or not robot.processor[kernel.POWERED]:
        return False
    kernel.reset(registers)
    # The motors keep their duty.
    registers[_LEFT_DUTY], registers[_RIGHT_DUTY] = left, right
    robot.processor[kernel.POWERED] = 0
    return True


@compilable
def _tick(robot: KheperaState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> bool:
    """Run the board's control loops once, from encoders to motor voltages."""
    registers, scene = robot.registers, simulated.scene
    left = units.wheel_pulses(joint_position(scene, robot.angles[0]))
    right = units.wheel_pulses(joint_position(scene, robot.angles[1]))
    kernel.run(registers, robot.processor, left, right)
    drive(scene, robot, 0)
    drive(scene, robot, 1)
    return False


@compilable
def drive(scene: Scene, robot: KheperaState, side: int) -> None:
    """Set the voltage of a motor (0 left, 1 right) by its duty."""
    duty = robot.registers[_RIGHT_DUTY if side else _LEFT_DUTY]
    voltage, motor, speed = units.duty_voltage(duty, robot.voltage[0]), robot.motors[side], robot.speeds[side]
    drive_motor(scene, robot.faults, side, motor, speed, robot.motor_constant, voltage)


@compilable
def _set_speeds(robot: KheperaState, left: int, right: int) -> None:
    """Set the speeds as command D does [pulses/10 ms]."""
    kernel.set_speed(robot.registers, kernel.LEFT, left)
    kernel.set_speed(robot.registers, kernel.RIGHT, right)


@compilable
def _command(robot: KheperaState, letter: int, left: int, right: int) -> None:
    """Execute D, P, C or G."""
    registers = robot.registers
    for side, value in ((kernel.LEFT, left), (kernel.RIGHT, right)):
        if letter == _D:
            kernel.set_speed(registers, side, kernel.clip(value, SPEED_LIMIT_PULSES))
        elif letter == _P:
            kernel.set_duty(registers, side, kernel.clip(value, units.DUTY_LIMIT))
        elif letter == _C:
            kernel.set_target(registers, side, kernel.clip(value, TARGET_LIMIT_PULSES))
        else:
            kernel.set_position(registers, side, kernel.clip(value, 2**31 - 1))


def _program(entry: RobotEntry, state: KheperaState) -> Firmware:
    """Return the firmware of a state."""
    arrays = (np.asarray(cast("NDArray[np.int64]", part)) for part in (state.registers, state.processor))
    return Firmware(ROMS[entry.rom], entry.mode, None, *arrays)


@compilable
def _is_powered(robot: KheperaState) -> bool:
    """Return whether the processor runs."""
    return robot.processor[kernel.POWERED] != 0


@compilable
def _wander(robot: KheperaState, registers: kernel.Registers) -> None:
    """Set the setpoints of the ROM's demonstration."""
    kernel.wander(registers)


CORE = register(
    Core(
        name="khepera",
        state=KheperaState,
        make_state=_make_state,
        changing=("registers", "processor", "voltage"),
        modules=("khep_twin.board.battery", "khep_twin.board.kernel", "khep_twin.robots.khepera.core"),
        sense=_sense,
        tick=_tick,
        measure_supply=_measure_supply,
        start=_start,
        scan=_scan,
        interface=KHEPERA_1.interface,
        set_speeds=_set_speeds,
        is_powered=_is_powered,
        wander=_wander,
        commands="DPCG",
        command=_command,
        counter_commands="G",
        program=_program,
    )
)
