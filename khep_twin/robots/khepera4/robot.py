"""A Khepera IV of a world: readings of its sensors, and the server on its serial line.

The stepping core runs it (`khepera4.core`). Its measurements are evaluated when a program, the server or a
log reads them.
"""

import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.robots.khepera4 import gauge, ultrasonic
from khep_twin.robots.khepera4.channels import PACKET_SIZE, ULTRASONIC_CODES
from khep_twin.robots.khepera4.core import wheel_pulses
from khep_twin.robots.khepera4.dspic import N_MEMORY, N_ULTRASONIC, Dspic
from khep_twin.robots.khepera4.inertial import COUNTS_LIMIT, GYROSCOPE_NS
from khep_twin.robots.khepera4.measurements import fill_registers
from khep_twin.robots.khepera4.model import SAMPLED
from khep_twin.robots.khepera4.motor_control import GAIN_SCALE, PWM_LIMIT
from khep_twin.robots.khepera4.registers import DspicRegister
from khep_twin.robots.khepera4.server import Kh4Server
from khep_twin.robots.khepera4.state import BURST, ECHO, INFRARED, NONE, Khepera4State
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.number_reader import LARGEST
from khep_twin.simulation.robot_arrays import Layout, Part, read
from khep_twin.simulation.world_state import POSITIONS, RobotSnapshot

_MOTOR = (
    Part("motor's position", 1, -(2**31), 2**31 - 1),
    Part("motor's speed", 1),
    Part("motor's pwm", 1, -PWM_LIMIT, PWM_LIMIT),
    Part("motor's flag of a target", 1, 0, 1),
    Part("motor's ramp", 1, -(2**15), 2**15),
    Part("motor's wait", 1, 0, 255),
    Part("motor's error", 1),
    Part("motor's sum of errors", 1, -PWM_LIMIT * GAIN_SCALE, PWM_LIMIT * GAIN_SCALE),
)

LAYOUT = Layout(
    1,
    {
        "dspic.memory": [Part("byte of the registers", N_MEMORY, 0, 255)],
        "dspic.motors": [*_MOTOR, *_MOTOR],
        "dspic.counts": [Part("pulses of an encoder", 2)],
        "dspic.powered": [Part("flag of the supply", 1, 0, 1)],
        "inertial.values": [Part("inertial value", 6 * PACKET_SIZE, -COUNTS_LIMIT, COUNTS_LIMIT - 1)],
        "inertial.lengths": [Part("length of an incomplete packet", 2, 0, PACKET_SIZE - 1)],
        "inertial.n_rates": [Part("samples of the gyroscope", 1, 0, LARGEST // GYROSCOPE_NS)],
        "inertial.velocity": [Part("velocity", 3)],
        "gauge": [
            Part("used charge", 1, 0, gauge.CAPACITY),
            Part("sum of currents", 1),
            Part("control periods of the sum", 1, 0, gauge.CURRENT_TICKS - 1),
            Part("measured current", 2),
        ],
        "zeros": [Part("zero of an encoder", 2)],
        "burst": [Part("last ultrasonic sensor", 1, NONE, N_ULTRASONIC - 1)],
        "distances": [Part("distance", N_ULTRASONIC, 0, max(ULTRASONIC_CODES))],
        "vehicle": [
            Part("flag of the vehicle", 2, 0, 1),
            Part("periods without motion", 1, 0),
            Part("vehicle's position", 2, -(2**31), 2**31 - 1),
        ],
    },
)
"""State of the robot in snapshots, besides the positions at the last burst."""

_BATTERY_EMPTY = "the battery is empty: the robot stands still"


class Khepera4Robot(Robot):
    """A Khepera IV of a world.

    Args:
        setup: See `Robot`.

    Attributes:
        dspic: Its microcontroller.
        registers: Values of `SAMPLED` at the last `refresh`.
    """

    firmware: Kh4Server
    sampled = SAMPLED
    layout = LAYOUT

    def __init__(self, setup: RobotSetup) -> None:
        self._state: Khepera4State = setup.context.simulation.robots.state_of(setup.index)
        self.dspic = Dspic(self._state.dspic)
        firmware = Kh4Server(self.dspic, self._state.vehicle)
        super().__init__(setup, firmware)
        self.dspic.before_read = self._evaluate_pending
        self.registers = self._record["registers"]
        setup.context.observers.evaluations.append(self.refresh)

    def act_after(self, reason: int) -> None:
        """Update faults before a control period, and act after it if the stepping core has asked for it."""
        super().act_after(reason)
        if reason == step.Reason.TICKED and self.dspic.is_powered:
            self.firmware.tick()
        elif reason == step.Reason.TICKED and not self._has_stopped:
            self._has_stopped = True
            self.stop_processor()
            self._context.observers.on_event(self.index, _BATTERY_EMPTY)

    def readings(self) -> dict[str, list[int]]:
        """Return the present values of its channels, by name."""
        self.refresh()
        return super().readings()

    def refresh(self) -> None:
        """Update `registers` to the present."""
        self._evaluate_all()
        fill_registers(self._state)

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        self._evaluate_all()
        snapshot, positions = super().state(since_ns), b""
        if self._state.burst[0] != NONE:
            positions = self._burst_positions.tobytes()
        return snapshot._replace(arrays={**snapshot.arrays, POSITIONS: positions})

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        arrays, time_ns = dict(state.arrays), self._context.time_ns
        positions = arrays.pop(POSITIONS, b"")
        super().set_state(state._replace(arrays=arrays))
        if (count := self._state.inertial.n_rates[0]) > (expected := time_ns // GYROSCOPE_NS):
            raise ValueError(f"inertial.n_rates = {count}; expected at most {expected}")
        if (powered := int(self.dspic.is_powered)) == state.is_stopped:
            raise ValueError(f"dspic.powered = {powered}; expected {1 - powered}")
        for moment in range(len(self._state.times)):
            self._state.times[moment] = NONE
        has_burst = self._state.burst[0] != NONE
        part = Part("joint's position", len(self._context.data.qpos) if has_burst else 0)
        numbers = read(POSITIONS, positions, [part], is_float=True)
        if has_burst:
            self._burst_positions[:] = numbers
            self._state.times[BURST] = time_ns // ultrasonic.PERIOD_NS * ultrasonic.PERIOD_NS

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        leds = self.dspic.leds
        return [int(any(leds[start : start + 3])) for start in range(0, 9, 3)]

    def reset_motion(self) -> None:
        """Reset the dsPIC, and cut the motors' voltage."""
        self.dspic.reset()
        self._record["inertial"]["velocity"] = 0
        self._context.data.ctrl[list(self.indices.motors)] = 0.0
        self._record["zeros"] = [wheel_pulses(self._context.data.qpos[i]) for i in self.indices.wheel_qpos]
        self._record["dspic"]["counts"] = 0

    @property
    def _burst_positions(self) -> NDArray[np.float64]:
        """Positions of all joints at the last burst."""
        row = self._context.moments.rows[self._state.first_moment + BURST]
        return row[: len(self._context.data.qpos)]

    def _evaluate_all(self) -> None:
        """Evaluate all pending measurements."""
        self._evaluate_pending(0, DspicRegister.BATTERY)

    def _evaluate_pending(self, first: int, end: int) -> None:
        """Evaluate pending measurements of the registers from `first` to before `end`."""
        times = self._state.times
        if times[INFRARED] != NONE and end > DspicRegister.AMBIENT and first < DspicRegister.ULTRASONIC:
            self._evaluate(INFRARED)
        if end > DspicRegister.ULTRASONIC and first < DspicRegister.ULTRASONIC_ENABLED:
            for moment in range(ECHO, ECHO + N_ULTRASONIC):
                if times[moment] != NONE:
                    self._evaluate(moment)
            enabled_mask = self.dspic.ultrasonic_enabled
            distances = self._state.distances
            readings = [
                distances[channel] if enabled_mask >> channel & 1 else ultrasonic.DISABLED
                for channel in range(N_ULTRASONIC)
            ]
            self.dspic.set_words(DspicRegister.ULTRASONIC, readings)

    def _evaluate(self, moment: int) -> None:
        """Evaluate a moment of the robot."""
        context, number = self._context, self._state.first_moment + moment
        context.simulation.evaluate(self.index, moment, number, context.moments)
