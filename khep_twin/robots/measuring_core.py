"""Core of a robot whose measurements are evaluated when a program, a log or its line reads them.

Its infrared sensors record a moment once in a period, its active ultrasonic sensors in turn. A moment is
evaluated when its readings are read; eager robots evaluate a burst at once. `measuring_core` adds the
functions for them to those of a model.
"""

import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from khep_twin.compilable import compilable
from khep_twin.playpen import RobotEntry
from khep_twin.robots.core import Core, register
from khep_twin.robots.model import RobotModel
from khep_twin.robots.vehicle import N_VEHICLE
from khep_twin.sensing.buffers import RobotState, Vector
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.ground import Ground, convert_any
from khep_twin.sensing.noise import draws
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensing.scene import Beams, copy_moment, save_moment, update_frames
from khep_twin.sensing.simulated import STEPS, Simulated, StepInputs, powers_row
from khep_twin.sensing.sonar import Sonar, cast_level_rays
from khep_twin.sensors import RobotFields, core_fields

INFRARED, BURST, ECHO = 0, 1, 2
"""Moments of a robot: of its infrared sensors, of the last burst, and of the last complete burst of each
ultrasonic sensor, from ECHO on."""

NONE = -1
"""No time of a moment; no ultrasonic sensor."""

_BOARD, _SENSING = ("kernel", "memory", "lithium_cells"), ("ground", "sonar")
_MODULES = (
    *(f"khep_twin.board.{name}" for name in _BOARD),
    *(f"khep_twin.sensing.{name}" for name in _SENSING),
    __name__,
)
"""Modules that these cores compile besides their own."""


class MeasuringFields(RobotFields):
    """Fields of the state of a robot with a measuring core.

    Attributes (see also `RobotFields`):
        idle_current: Current with the motors at rest [A].
        pulses_per_radian: Pulses of an encoder per angle of its wheel [1/rad].
        is_discharged: 1 if the battery is discharged during the run.
        first_moment: Number of its first moment.
        ground: Sensors that look at the floor.
        sonar: Ultrasonic sensors.
        beams: Buffers for their rays.
        burst: Sensor of the last burst, or NONE (1,).
        is_eager: 1 if a burst is evaluated immediately, without a moment (1,).
        times: Time of each moment, NONE if there is nothing to evaluate (n_moments,) [ns].
        vehicle: State of the vehicle of the program on its line (N_VEHICLE,).
        registers: Registers as in logs (n_registers,).
    """

    idle_current: float
    pulses_per_radian: float
    is_discharged: int
    first_moment: int
    ground: Ground
    sonar: Sonar
    beams: Beams
    burst: Vector[int]
    is_eager: Vector[int]
    times: Vector[int]
    vehicle: Vector[int]
    registers: Vector[int]


def measuring_fields(
    model: mujoco.MjModel, robot: RobotIndices, measured: Calibration, entry: RobotEntry, first_moment: int
) -> dict[str, Any]:
    """Return the `MeasuringFields` of a state; the arguments are those of `make_state`."""
    body = entry.body
    assert body.sonar is not None
    sonar = Sonar.of(body.sonar, noise_cm=0.4)  # noise and lens are assumed
    return {
        **core_fields(model, robot, measured, entry, first_moment),
        "idle_current": body.idle_current,
        "pulses_per_radian": body.pulses_per_turn / math.tau,
        "is_discharged": int(entry.battery_used_min is not None),
        "first_moment": first_moment,
        "ground": Ground.of(measured, body.ground_height, lens=0.002),
        "sonar": sonar,
        "beams": Beams.of(len(sonar.gains)),
        "burst": np.full(1, NONE),
        "is_eager": np.zeros(1, np.int64),
        "times": np.full(ECHO + len(body.sonar.names), NONE),
        "vehicle": np.zeros(N_VEHICLE, np.int64),
        "registers": np.zeros(entry.robot_model.episode_interface.n_registers, np.int64),
    }


def measuring_core(
    model: RobotModel,
    state: type[MeasuringFields],
    start: Callable[..., None],
    scan_ns: int,
    set_infrared: Callable[..., None],
    burst_ns: int,
    active_mask: Callable[..., int],
    measure_burst: Callable[..., None],
    keep_burst: Callable[..., None],
    fill_registers: Callable[..., None],
    *,
    changing: tuple[str, ...],
    modules: Collection[str],
    **fields: Any,
) -> Core:
    """Return the registered core of a family of models. The functions are `compilable`.

    Args:
        model: One of them.
        state: Class of a robot's state.
        start: Starts a robot's run, before the first measurement.
        scan_ns: Period of the infrared sensors [ns].
        set_infrared: Sets proximity and ambient counts of an infrared sensor of a robot, by its number.
        burst_ns: Time from one burst to the next [ns].
        active_mask: Returns the mask of a robot's active ultrasonic sensors.
        measure_burst: Measures with an ultrasonic sensor, by a robot, a scene, inputs, its number and a time.
        keep_burst: Makes this measurement of a robot the reading of the sensor, by its number.
        fill_registers: Sets the other registers of a robot.
        changing: Fields of the state that change, besides those of `MeasuringFields`.
        modules: Names of the compiled modules in the folder of `state`.
        fields: Further fields of the core.
    """
    record = _make_recorder(scan_ns, burst_ns, active_mask, measure_burst, keep_burst)
    evaluate_scan = _make_scan(scan_ns, set_infrared)

    @compilable
    def start_recording(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> bool:
        """Start the run, and record the moments of time 0."""
        start(robot, simulated)
        record(robot, simulated, inputs, 0)
        return False

    @compilable
    def sense(robot: RobotState, simulated: Simulated, inputs: StepInputs, start: int) -> None:
        """Record the moments of a step, if any are due."""
        if start >= 0:
            record(robot, simulated, inputs, simulated.counters[STEPS] * simulated.timing.step_ns)

    @compilable
    def evaluate(robot: RobotState, simulated: Simulated, inputs: StepInputs, part: int) -> None:
        """Evaluate the moment INFRARED, or that of an ultrasonic sensor from ECHO on."""
        if part == INFRARED:
            evaluate_scan(robot, simulated, inputs, inputs.powers[0])
        else:
            measure_burst(robot, simulated.scene, inputs, part - ECHO, robot.times[part])
            keep_burst(robot, part - ECHO)
            robot.times[part] = NONE

    @compilable
    def update_registers(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> None:
        """Evaluate the infrared sensors, whose moment is the present, and set the registers."""
        if robot.times[INFRARED] != NONE:
            update_frames(simulated.scene)
            evaluate_scan(robot, simulated, inputs, inputs.powers[powers_row(simulated, inputs)])
        fill_registers(robot)

    fields.setdefault("request_terms", request_terms)
    core = Core(
        name=model.family,
        state=state,
        changing=("beams", "burst", "times", "vehicle", "registers", *changing),
        n_moments=ECHO + len(model.body.fault_sensors) - len(model.body.sensors),
        modules=(*_MODULES, *(f"{state.__module__.rpartition('.')[0]}.{name}" for name in modules)),
        sense=sense,
        start=start_recording,
        evaluate=evaluate,
        scan=_scan,
        interface=model.interface,
        update_registers=update_registers,
        echo=cast_level_rays,
        **fields,
    )
    return register(core)


def _make_recorder(
    scan_ns: int,
    burst_ns: int,
    active_mask: Callable[..., int],
    measure_burst: Callable[..., None],
    keep_burst: Callable[..., None],
) -> Callable[..., None]:
    """Return the function that records moments, by arguments of `measuring_core`."""

    @compilable
    def record(robot: RobotState, simulated: Simulated, inputs: StepInputs, time_ns: int) -> None:
        """Record the moments that have become due in a step that ends at a time [ns]."""
        scene, first, times, last = simulated.scene, robot.first_moment, robot.times, robot.burst[0]
        step_ns = simulated.timing.step_ns
        if time_ns % scan_ns < step_ns:
            save_moment(scene, first + INFRARED, inputs.powers[powers_row(simulated, inputs)])
            times[INFRARED] = time_ns
        if time_ns % burst_ns >= step_ns:
            return
        if last != NONE and robot.is_eager[0]:
            keep_burst(robot, last)
        elif last != NONE:
            copy_moment(scene, first + BURST, first + ECHO + last)
            times[ECHO + last] = times[BURST]
        sensor = robot.burst[0] = _next_sensor(last, active_mask(robot), len(times) - ECHO)
        if sensor == NONE:
            return
        times[BURST] = time_ns
        if robot.is_eager[0]:
            update_frames(scene)
            measure_burst(robot, scene, inputs, sensor, time_ns)
        else:
            save_moment(scene, first + BURST, inputs.powers[powers_row(simulated, inputs)])

    return record


def _make_scan(scan_ns: int, set_infrared: Callable[..., None]) -> Callable[..., None]:
    """Return the function that evaluates the infrared sensors, by arguments of `measuring_core`."""

    @compilable
    def evaluate_scan(
        robot: RobotState, simulated: Simulated, inputs: StepInputs, powers: Sequence[float]
    ) -> None:
        """Measure with the infrared sensors in a scene at their moment."""
        scene, sensors, time_ns = simulated.scene, robot.sensors, robot.times[INFRARED]
        n_sensors = len(sensors.cameras)
        for channel in range(n_sensors):
            random = draws(inputs.tables, robot.noise, time_ns // scan_ns * n_sensors + channel)
            proximity, ambient = convert_any(
                scene, sensors, robot.ground, simulated.light, powers, time_ns, channel, random
            )
            set_infrared(robot, channel, proximity, ambient)
        robot.times[INFRARED] = NONE

    return evaluate_scan


def request_terms(record: RobotState, names: Collection[str]) -> None:
    """Evaluate each burst immediately if the ultrasonic sensors are among the terms."""
    record["is_eager"] = "ultrasonic" in names


@compilable
def wheel_pulses(robot: MeasuringFields, angle: float) -> int:
    """Return the pulses of an encoder at a wheel's angle [rad]."""
    return math.floor(angle * robot.pulses_per_radian + 0.5)


def _scan(robot: RobotState, simulated: Simulated, inputs: StepInputs) -> None:
    """Measure with all infrared sensors now."""
    save_moment(simulated.scene, robot.first_moment + INFRARED, inputs.powers[0])
    robot.times[INFRARED] = simulated.counters[STEPS] * simulated.timing.step_ns


@compilable
def _next_sensor(last: int, active_mask: int, n_sensors: int) -> int:
    """Return the active ultrasonic sensor after the last one, or NONE."""
    for offset in range(1, n_sensors + 1):
        sensor = (last + offset) % n_sensors
        if active_mask >> sensor & 1:
            return sensor
    return NONE
