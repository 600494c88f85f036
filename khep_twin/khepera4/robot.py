"""A Khepera IV of a world: microcontroller, sensors, motors, battery, and the server at its line.

It runs between the steps of the stepping core. A control period of 10 ms ends with

    1. pulses of the encoders, the dsPIC's control, voltage of the motors
    2. a value of the accelerometer, and of the gyroscope where it is due
    3. the battery's charge, and the server's vehicle

Infrared sensors measure every 5 ms, an enabled ultrasonic one every 20 ms (`moments`).
"""

import math
from collections.abc import Callable, Sequence
from itertools import accumulate

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL
from khep_twin.errors import FaultError
from khep_twin.khepera4 import infrared, ultrasonic
from khep_twin.khepera4.channels import CHANNELS
from khep_twin.khepera4.dspic import N_INFRARED, N_ULTRASONIC, Dspic
from khep_twin.khepera4.gauge import CUT_OFF, Gauge
from khep_twin.khepera4.inertial import Inertial
from khep_twin.khepera4.infrared import Infrared
from khep_twin.khepera4.moments import Moment, PastScene
from khep_twin.khepera4.motor_control import PWM_LIMIT
from khep_twin.khepera4.registers import DspicRegister
from khep_twin.khepera4.server import Kh4Server
from khep_twin.khepera4.ultrasonic import Ultrasonic
from khep_twin.robot import Robot, RobotSettings, SampledRegisters, WorldContext
from khep_twin.sensing.calibration import Calibration
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.world_state import BoardState, RobotSnapshot
from khep_twin.units import BODIES

PULSES_PER_TURN = BODIES["khepera4"].pulses_per_turn
"""Pulses of an encoder in a turn of its wheel (manual)."""

_ENDS = [0, *accumulate(label.count(",") + 1 for label in CHANNELS.values())]

SAMPLED = tuple(
    SampledRegisters(name, label, range(start, end))
    for (name, label), start, end in zip(CHANNELS.items(), _ENDS, _ENDS[1:], strict=False)
)
"""Channels of a log, one behind the other in the robot's registers."""

_OFF = "the battery is empty: the robot stands still"


class Khepera4Robot(Robot):
    """A Khepera IV of a world.

    Args:
        context: World of the robot.
        index: Index among the playpen's robots.
        indices: Indices in the scene.
        calibration: Its calibration in this run.
        rng: Function that returns a random stream of the robot by its name.
        settings: Settings of the world's robots.

    Attributes:
        dspic: Its microcontroller.
        registers: Values of SAMPLED, as of the last `refresh`.

    Raises:
        FaultError: A fault is none of the line.
    """

    firmware: Kh4Server
    sampled = SAMPLED

    def __init__(
        self,
        context: WorldContext,
        index: int,
        indices: RobotIndices,
        calibration: Calibration,
        rng: Callable[..., np.random.Generator],
        settings: RobotSettings,
    ) -> None:
        for fault in settings.faults:
            if fault.device in (SENSOR, MOTOR, WHEEL):
                raise FaultError(
                    f"fault {fault.text!r}: robot {index} is a Khepera IV; expected a fault of its line"
                )
        self.dspic = Dspic()
        super().__init__(context, index, indices, Kh4Server(self.dspic), rng, settings)
        self.dspic.before_read = self._before_read
        self.registers = np.zeros(_ENDS[-1], np.int64)
        self._calibration, motors = calibration, calibration.motors
        self._constant, self._supply_v = motors.constant, motors.supply_v
        entry = context.playpen.robots[index]
        self._idle_current = entry.body.idle_current
        self._gauge = Gauge(entry.battery_used_min)
        self._zeros = [0, 0]
        self._has_stopped = False
        self._infrared_due: Moment | None = None
        self._echoes_due: dict[int, Moment] = {}
        self._burst: tuple[int, Moment] | None = None
        self._echoes = [ultrasonic.NOTHING] * N_ULTRASONIC
        self._take_key()

    def switch_on(self) -> None:
        """Begin the run, at time 0."""
        self.zero_encoders()
        self.dspic.set_battery(self._gauge.block)
        self._measure(self._context.time_ns)

    def act_after(self, reason: int) -> None:
        """Measure after a step of the physics, and control after a control period."""
        context = self._context
        if reason == step.STEPPED:
            self._measure(context.time_ns)
        elif reason == step.TICKED:
            changed = self.faults.update(("",), context.time_ns)
            if any(fault.kind == "brown-out" for fault in changed):
                self.reset_processor()
            if not self._has_stopped:
                self._tick(context.time_ns)

    def refresh(self) -> None:
        """Bring the registers up to the present."""
        self._before_read(0, DspicRegister.BATTERY)
        dspic, values = self.dspic, self.registers
        motors = [each for numbers in dspic.motor_numbers for each in numbers]
        battery = dspic.read(DspicRegister.BATTERY, 12)
        block = [int.from_bytes(battery[at : at + 2], "little", signed=at in (4, 8)) for at in (10, 4, 1, 8)]
        control = dspic.read(DspicRegister.CONTROL, 1)[0], dspic.read(DspicRegister.ON_TARGET, 1)[0]
        newest = [
            axis[0] for packets in (self._inertial.accelerations, self._inertial.rates) for axis in packets
        ]
        values[:] = [
            *dspic.words(DspicRegister.PROXIMITY, N_INFRARED),
            *dspic.words(DspicRegister.AMBIENT, N_INFRARED),
            *dspic.words(DspicRegister.ULTRASONIC, N_ULTRASONIC),
            *motors,
            *dspic.leds,
            *newest,
            *block,
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
        sonar = burst, *self._echoes
        integers = [*self._zeros, *sonar, *self.firmware.numbers, len(inertial), *inertial, *dspic]
        qpos: list[float] = [] if self._burst is None else self._burst[1].qpos.tolist()
        return RobotSnapshot(
            **self.board_state(since_ns)._asdict(),
            registers=self.registers.tobytes(),
            processor=np.array(integers, np.int64).tobytes(),
            sensor_states=b"",
            strengths=np.array([*velocity, *self._gauge.state(), *qpos]).tobytes(),
            voltage=np.array([self._gauge.voltage]).tobytes(),
            stopped=self._has_stopped,
            leds=tuple(self._shown),
        )

    def set_state(self, state: RobotSnapshot) -> None:
        """Take over a state.

        Raises:
            ValueError: It is of another robot, or another line.
        """
        if len(state.registers) != self.registers.nbytes:
            raise ValueError(f"{len(state.registers)} bytes of registers; expected {self.registers.nbytes}")
        left = iter(np.frombuffer(state.processor, np.int64).tolist())
        floats = np.frombuffer(state.strengths).tolist()
        self.registers[:] = np.frombuffer(state.registers, np.int64)
        self.set_board_state(BoardState(*(getattr(state, name) for name in BoardState._fields)))
        self._zeros = [next(left), next(left)]
        burst = next(left)
        self._echoes = [next(left) for _ in range(N_ULTRASONIC)]
        self.firmware.numbers = [next(left) for _ in self.firmware.numbers]
        self._take_key()
        self._inertial.set_state([next(left) for _ in range(next(left))], floats[:3])
        self.dspic.set_state(list(left))
        self._gauge.set_state(floats[3:8])
        self._infrared_due, self._echoes_due = None, {}
        time_ns = self._context.time_ns // ultrasonic.PERIOD_NS * ultrasonic.PERIOD_NS
        self._burst = None if burst < 0 else (burst, self._moment(time_ns, np.array(floats[8:])))
        self._has_stopped = state.stopped
        self.dspic.is_powered = not state.stopped
        self._show(state.leds)

    def reseed(self, seed_of: Callable[..., np.random.Generator]) -> None:
        """Draw from other random streams from now on."""
        super().reseed(seed_of)
        self._before_read(0, DspicRegister.BATTERY)
        self.fit_turrets()

    def fit_turrets(self) -> None:
        """Make the sensors anew, for the scene and the random draws as they are now."""
        inertial = self._inertial.state()
        self._take_key()
        self._inertial.set_state(*inertial)

    def scan(self) -> None:
        """Measure by all infrared sensors now."""
        self._infrared_due = self._moment(self._context.time_ns)

    def apply_faults(self) -> None:
        """Do nothing, as only its line has faults."""

    @property
    def lit_leds(self) -> list[int]:
        """LEDs as the registers have them, 0 for an unlit one."""
        leds = self.dspic.leds
        return [int(any(leds[first : first + 3])) for first in range(0, 9, 3)]

    def reset_motion(self) -> None:
        """Reset the dsPIC, and cut the motors' voltage."""
        self.dspic.reset()
        self.zero_encoders()
        self._inertial.rest()
        self._context.data.ctrl[list(self.indices.motors)] = 0.0

    def zero_encoders(self) -> None:
        """Set the encoders to the wheels' current angles."""
        self._zeros, self.dspic.counts = self._wheel_pulses(), (0, 0)

    def _take_key(self) -> None:
        """Draw the sensors' noise by the present key of the simulation."""
        simulation = self._context.simulation
        past, words = PastScene(self._context.model), simulation.key_words(self.index)
        noisy = simulation.is_noisy
        self._infrared = Infrared(past, self.indices, self._calibration, words, noisy)
        self._ultrasonic = Ultrasonic(past, self.indices, words, noisy)
        self._inertial = Inertial(words, noisy)

    def _wheel_pulses(self) -> list[int]:
        angles: Sequence[float] = self._context.data.qpos[list(self.indices.wheel_angles)].tolist()
        return [math.floor(angle * (PULSES_PER_TURN / math.tau) + 0.5) for angle in angles]

    def _moment(self, time_ns: int, qpos: NDArray[np.float64] | None = None) -> Moment:
        context = self._context
        simulation = context.simulation
        places = context.data.qpos.copy() if qpos is None else qpos
        return Moment(time_ns, places, simulation.plain.light, simulation.powers)

    def _measure(self, time_ns: int) -> None:
        """Measure what is due at the end of a step of the physics."""
        if time_ns % infrared.PERIOD_NS:
            return
        self._infrared_due = moment = self._moment(time_ns)
        if time_ns % ultrasonic.PERIOD_NS:
            return
        if self._burst is not None:
            sensor, begun = self._burst
            self._echoes_due[sensor] = begun
        enabled = self.dspic.ultrasonic_enabled
        last = -1 if self._burst is None else self._burst[0]
        following = [(last + 1 + each) % N_ULTRASONIC for each in range(N_ULTRASONIC)]
        sensor = next((each for each in following if enabled >> each & 1), None)
        self._burst = None if sensor is None else (sensor, moment)

    def _before_read(self, first: int, last: int) -> None:
        """Bring registers up to the present before they are read: the first to the one before the last."""
        dspic, due = self.dspic, self._infrared_due
        if due is not None and last > DspicRegister.AMBIENT and first < DspicRegister.ULTRASONIC:
            near, light = self._infrared.measure(due)
            self._infrared_due = None
            dspic.sense(DspicRegister.PROXIMITY, near)
            dspic.sense(DspicRegister.AMBIENT, light)
        if last > DspicRegister.ULTRASONIC and first < DspicRegister.ULTRASONIC_ENABLED:
            for sensor, moment in sorted(self._echoes_due.items()):
                self._echoes[sensor] = self._ultrasonic.measure(moment, sensor)
            self._echoes_due = {}
            enabled = dspic.ultrasonic_enabled
            seen = [
                echo if enabled >> each & 1 else ultrasonic.DISABLED for each, echo in enumerate(self._echoes)
            ]
            dspic.sense(DspicRegister.ULTRASONIC, seen)
        if last > DspicRegister.ACCELEROMETER and first < DspicRegister.BATTERY:
            for register, packets in (
                (DspicRegister.ACCELEROMETER, self._inertial.accelerations),
                (DspicRegister.GYROSCOPE, self._inertial.rates),
            ):
                dspic.sense(register, [each for axis in packets for each in axis])

    def _tick(self, time_ns: int) -> None:
        """Run a control period."""
        data, indices = self._context.data, self.indices
        pulses = [now - zero for now, zero in zip(self._wheel_pulses(), self._zeros, strict=True)]
        pwm = self.dspic.tick(*pulses)
        current = self._idle_current
        voltage = self._gauge.voltage
        for motor, part in zip(indices.motors, pwm, strict=True):
            data.ctrl[motor] = part / PWM_LIMIT * voltage
            drawn = part / PWM_LIMIT * float(data.actuator_force[motor]) / self._constant
            current += max(drawn, 0.0)
        first = indices.velocity
        velocity: Sequence[float] = data.qvel[first : first + 6].tolist()
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, data.qpos[indices.pose + 3 : indices.pose + 7])
        self._inertial.tick(time_ns, turn.tolist(), velocity[:3], velocity[3:])
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
            self._context.on_event(self.index, _OFF)
