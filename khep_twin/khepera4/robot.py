"""A Khepera IV of a world: microcontroller, sensors, motors, battery, and the server on its serial line.

It runs between the steps of the stepping core. At the end of a control period of 10 ms it updates

    1. pulses of the encoders, the dsPIC's control, voltage of the motors
    2. the accelerometer, and the gyroscope if a value is due
    3. the battery's charge, and the server's vehicle

Infrared sensors measure every 5 ms, an enabled ultrasonic one every 20 ms (`moments`).
"""

import math
from collections.abc import Callable, Sequence
from itertools import accumulate, chain

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL
from khep_twin.errors import FaultError
from khep_twin.khepera4 import infrared, ultrasonic
from khep_twin.khepera4.channels import CHANNELS, ULTRASONIC_CODES
from khep_twin.khepera4.dspic import N_INFRARED, N_ULTRASONIC, Dspic
from khep_twin.khepera4.gauge import CUT_OFF, Gauge
from khep_twin.khepera4.inertial import Inertial
from khep_twin.khepera4.infrared import Infrared
from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.khepera4.motor_control import PWM_LIMIT
from khep_twin.khepera4.registers import BATTERY_BYTES, DspicRegister
from khep_twin.khepera4.server import Kh4Server
from khep_twin.khepera4.ultrasonic import Ultrasonic
from khep_twin.robot import Robot, RobotSettings, SampledRegisters, WorldContext
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.number_reader import NumberReader, read_floats, read_integers
from khep_twin.simulation.world_state import BoardState, RobotSnapshot
from khep_twin.units import BODIES

PULSES_PER_TURN = BODIES["khepera4"].pulses_per_turn
"""Pulses of an encoder in a turn of its wheel (manual)."""

_CHANNEL_ENDS = [0, *accumulate(label.count(",") + 1 for label in CHANNELS.values())]

SAMPLED = tuple(
    SampledRegisters(name, label, range(start, end))
    for (name, label), start, end in zip(CHANNELS.items(), _CHANNEL_ENDS, _CHANNEL_ENDS[1:], strict=False)
)
"""Channels of a log, consecutive in the robot's registers."""

_BATTERY_EMPTY = "the battery is empty: the robot stands still"


class Khepera4Robot(Robot):
    """A Khepera IV of a world.

    Args:
        context, index, indices, make_rng, settings: See `Robot`.
        calibration: Its calibration in this run.

    Attributes:
        dspic: Its microcontroller.
        registers: Values of `SAMPLED` at the last `refresh`.

    Raises:
        FaultError: A fault is not one of the line.
    """

    firmware: Kh4Server
    sampled = SAMPLED

    def __init__(
        self,
        context: WorldContext,
        index: int,
        indices: RobotIndices,
        calibration: Calibration,
        make_rng: Callable[..., np.random.Generator],
        settings: RobotSettings,
    ) -> None:
        for fault in settings.faults:
            if fault.device in (SENSOR, MOTOR, WHEEL):
                raise FaultError(
                    f"fault {fault.text!r}: robot {index} is a Khepera IV; expected a fault of its line"
                )
        self.dspic = Dspic()
        super().__init__(context, index, indices, Kh4Server(self.dspic), make_rng, settings)
        self.dspic.before_read = self._evaluate_pending
        self.registers = np.zeros(_CHANNEL_ENDS[-1], np.int64)
        self._calibration = calibration
        self._motor_constant = calibration.motors.constant
        robot_entry = context.playpen.robots[index]
        self._idle_current = robot_entry.body.idle_current
        self._gauge = Gauge(robot_entry.battery_used_min)
        self._encoder_zeros = [0, 0]
        self._has_stopped = False
        self._pending_infrared: Moment | None = None
        self._pending_bursts: dict[int, Moment] = {}
        self._burst: tuple[int, Moment] | None = None  # sensor and time of the last burst
        self._distance_readings = [ultrasonic.NO_ECHO] * N_ULTRASONIC
        self._make_sensors()

    def switch_on(self) -> None:
        """Start the run at time 0."""
        self.zero_encoders()
        self.dspic.set_battery(self._gauge.block)
        self._measure(self._context.time_ns)

    def act_after(self, reason: int) -> None:
        """Measure after a physics step, and run the controllers after a control period."""
        context = self._context
        if reason == step.Reason.STEPPED:
            self._measure(context.time_ns)
        elif reason == step.Reason.TICKED:
            changed_faults = self.faults.update(("",), context.time_ns)
            if any(fault.kind == "brown-out" for fault in changed_faults):
                self.reset_processor()
            if not self._has_stopped:
                self._run_control_period(context.time_ns)

    def refresh(self) -> None:
        """Update `registers` to the present."""
        self._evaluate_pending(0, DspicRegister.BATTERY)
        dspic, values = self.dspic, self.registers
        motor_values = [number for numbers in dspic.motor_numbers for number in numbers]
        battery = dspic.read(DspicRegister.BATTERY, BATTERY_BYTES)  # voltage, current, charge, temperature
        gauge = [int.from_bytes(battery[i : i + 2], "little", signed=i in (4, 8)) for i in (10, 4, 1, 8)]
        control = dspic.read(DspicRegister.CONTROL, 1)[0], dspic.read(DspicRegister.ON_TARGET, 1)[0]
        newest_inertial = [axis[0] for axis in (*self._inertial.accelerations, *self._inertial.rates)]
        values[:] = [
            *dspic.words(DspicRegister.PROXIMITY, N_INFRARED),
            *dspic.words(DspicRegister.AMBIENT, N_INFRARED),
            *dspic.words(DspicRegister.ULTRASONIC, N_ULTRASONIC),
            *motor_values,
            *dspic.leds,
            *newest_inertial,
            *gauge,
            *control,
            dspic.ultrasonic_enabled,
            dspic.read(DspicRegister.STATUS_LED, 1)[0],
        ]

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        self.refresh()
        inertial, velocity = self._inertial.state()
        burst = -1 if self._burst is None else self._burst[0]
        dspic = self.dspic.state()
        sonar = burst, *self._distance_readings
        integers = [*self._encoder_zeros, *sonar, *self.firmware.numbers, *inertial, *dspic]
        qpos: list[float] = [] if self._burst is None else self._burst[1].qpos.tolist()
        return RobotSnapshot(
            **self.board_state(since_ns)._asdict(),
            registers=self.registers.tobytes(),
            processor=np.array(integers, np.int64).tobytes(),
            sensor_states=b"",
            strengths=np.array([*velocity, *self._gauge.state(), *qpos]).tobytes(),
            voltage=np.array([self._gauge.voltage]).tobytes(),
            is_stopped=self._has_stopped,
            leds=tuple(self._shown_leds),
        )

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        numbers, floats = (
            read_integers("processor", state.processor),
            read_floats("strengths", state.strengths),
        )
        registers, voltage = (
            read_integers("registers", state.registers),
            read_floats("voltage", state.voltage),
        )
        read_integers("sensor_states", state.sensor_states).end()
        self.set_board_state(BoardState(*(getattr(state, name) for name in BoardState._fields)))
        self._encoder_zeros = numbers.take("zero of an encoder", 2)
        (burst,) = numbers.take("last ultrasonic sensor", 1, -1, N_ULTRASONIC - 1)
        self._distance_readings = numbers.take("distance", N_ULTRASONIC, 0, max(ULTRASONIC_CODES))
        self.firmware.set_numbers(numbers)
        self._make_sensors()
        self._inertial.set_state(numbers, floats, self._context.time_ns)
        self.dspic.set_state(numbers)
        self._gauge.set_state(floats)
        self._pending_infrared = None
        self._pending_bursts = {}
        time_ns = self._context.time_ns // ultrasonic.PERIOD_NS * ultrasonic.PERIOD_NS
        positions = floats.take("joint's position", 0 if burst < 0 else len(self._context.data.qpos))
        self._burst = None if burst < 0 else (burst, self._record_moment(time_ns, np.array(positions)))
        self._has_stopped = state.is_stopped
        self.dspic.is_powered = not state.is_stopped
        self._set_led_lights(state.leds)
        self.refresh()
        for register in self.registers.tolist():
            registers.take("register", 1, register, register)
        voltage.take("voltage", 1, self._gauge.voltage, self._gauge.voltage)
        for reader in (numbers, floats, registers, voltage):
            reader.end()

    def move_measurements(self, state: RobotSnapshot, qpos: NDArray[np.float64]) -> RobotSnapshot:
        """Return a state whose last burst has the positions `qpos` of another scene."""
        if self._burst is None:
            return state
        n_other = len(state.strengths) - self._burst[1].qpos.nbytes
        return state._replace(strengths=state.strengths[:n_other] + qpos.tobytes())

    def reseed(self, make_rng: Callable[..., np.random.Generator]) -> None:
        """Replace the random streams."""
        super().reseed(make_rng)
        self._evaluate_pending(0, DspicRegister.BATTERY)
        self.fit_turrets()

    def fit_turrets(self) -> None:
        """Recreate the sensors for the present scene and random streams."""
        integers, velocity = self._inertial.state()
        self._make_sensors()
        readers = NumberReader("inertial", integers), NumberReader("velocity", velocity)
        self._inertial.set_state(*readers, self._context.time_ns)

    def scan(self) -> None:
        """Measure with all infrared sensors now."""
        self._pending_infrared = self._record_moment(self._context.time_ns)

    def apply_faults(self) -> None:
        """Do nothing: only the line has faults."""

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        leds = self.dspic.leds
        return [int(any(leds[start : start + 3])) for start in range(0, 9, 3)]

    def reset_motion(self) -> None:
        """Reset the dsPIC, and cut the motors' voltage."""
        self.dspic.reset()
        self.zero_encoders()
        self._inertial.reset_velocity()
        self._context.data.ctrl[list(self.indices.motors)] = 0.0

    def zero_encoders(self) -> None:
        """Set the encoders to the wheels' current angles."""
        self._encoder_zeros = self._wheel_pulses()
        self.dspic.counts = 0, 0

    def _make_sensors(self) -> None:
        """Create the sensors, with noise from the present key of the simulation."""
        simulation = self._context.simulation
        scene = PastScene(self._context.model)
        key, noise = simulation.key_words(self.index), simulation.noise
        self._infrared = Infrared(scene, self.indices, self._calibration, key, noise)
        self._ultrasonic = Ultrasonic(scene, self.indices, key, noise)
        self._inertial = Inertial(key, noise)

    def _wheel_pulses(self) -> list[int]:
        angles: Sequence[float] = self._context.data.qpos[list(self.indices.wheel_qpos)].tolist()
        return [math.floor(angle * (PULSES_PER_TURN / math.tau) + 0.5) for angle in angles]

    def _record_moment(self, time_ns: int, qpos: NDArray[np.float64] | None = None) -> Moment:
        context = self._context
        simulation = context.simulation
        positions = context.data.qpos.copy() if qpos is None else qpos
        return Moment(time_ns, positions, simulation.plain.light, simulation.powers)

    def _measure(self, time_ns: int) -> None:
        """Record the measurements that are due at the end of a physics step."""
        if time_ns % infrared.PERIOD_NS:
            return
        self._pending_infrared = moment = self._record_moment(time_ns)
        if time_ns % ultrasonic.PERIOD_NS:
            return
        if self._burst is not None:
            sensor, burst_moment = self._burst
            self._pending_bursts[sensor] = burst_moment
        enabled_mask = self.dspic.ultrasonic_enabled
        last_sensor = -1 if self._burst is None else self._burst[0]
        candidates = [(last_sensor + 1 + offset) % N_ULTRASONIC for offset in range(N_ULTRASONIC)]
        sensor = next((candidate for candidate in candidates if enabled_mask >> candidate & 1), None)
        self._burst = None if sensor is None else (sensor, moment)

    def _evaluate_pending(self, first: int, end: int) -> None:
        """Evaluate pending measurements of the registers from `first` to before `end`."""
        dspic, infrared_due = self.dspic, self._pending_infrared
        if infrared_due is not None and end > DspicRegister.AMBIENT and first < DspicRegister.ULTRASONIC:
            proximity_counts, ambient_counts = self._infrared.measure(infrared_due)
            self._pending_infrared = None
            dspic.set_words(DspicRegister.PROXIMITY, proximity_counts)
            dspic.set_words(DspicRegister.AMBIENT, ambient_counts)
        if end > DspicRegister.ULTRASONIC and first < DspicRegister.ULTRASONIC_ENABLED:
            for sensor, moment in sorted(self._pending_bursts.items()):
                self._distance_readings[sensor] = self._ultrasonic.measure(moment, sensor)
            self._pending_bursts = {}
            enabled_mask = dspic.ultrasonic_enabled
            readings = [
                reading if enabled_mask >> channel & 1 else ultrasonic.DISABLED
                for channel, reading in enumerate(self._distance_readings)
            ]
            dspic.set_words(DspicRegister.ULTRASONIC, readings)
        if end > DspicRegister.ACCELEROMETER and first < DspicRegister.BATTERY:
            dspic.set_words(DspicRegister.ACCELEROMETER, [*chain(*self._inertial.accelerations)])
            dspic.set_words(DspicRegister.GYROSCOPE, [*chain(*self._inertial.rates)])

    def _run_control_period(self, time_ns: int) -> None:
        """Run a control period."""
        data, indices = self._context.data, self.indices
        pulses = [count - zero for count, zero in zip(self._wheel_pulses(), self._encoder_zeros, strict=True)]
        pwm = self.dspic.tick(*pulses)
        current = self._idle_current
        voltage = self._gauge.voltage
        for motor, motor_pwm in zip(indices.motors, pwm, strict=True):
            data.ctrl[motor] = motor_pwm / PWM_LIMIT * voltage
            motor_current = motor_pwm / PWM_LIMIT * float(data.actuator_force[motor]) / self._motor_constant
            current += max(motor_current, 0.0)
        start = indices.velocity
        velocity: Sequence[float] = data.qvel[start : start + 6].tolist()
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, data.qpos[indices.pose + 3 : indices.pose + 7])
        self._inertial.tick(time_ns, rotation.tolist(), velocity[:3], velocity[3:])
        if self._gauge.tick(current):
            self.dspic.set_battery(self._gauge.block)
        self.firmware.tick()
        if voltage <= CUT_OFF:
            self._has_stopped = True
            self.dspic.reset()
            self.dspic.is_powered = False
            self.dspic.set_battery(self._gauge.block)
            data.ctrl[list(indices.motors)] = 0.0
            self.stop_processor()
            self._context.on_event(self.index, _BATTERY_EMPTY)
