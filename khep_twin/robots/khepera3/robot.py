"""A Khepera III of a world: its bus, readings of its sensors, and the program on its serial line.

The stepping core runs it (`khepera3.core`). Its measurements are evaluated when a program or a log reads them.
"""

import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.channels import PWM_LIMIT
from khep_twin.robots.khepera3.core import wheel_pulses
from khep_twin.robots.khepera3.letters import Letters
from khep_twin.robots.khepera3.measurements import BURST_NS, fill_registers
from khep_twin.robots.khepera3.model import SAMPLED, version_of
from khep_twin.robots.khepera3.motor_control import N_MOTOR
from khep_twin.robots.khepera3.registers import N_BYTES, Mode
from khep_twin.robots.khepera3.state import (
    BURST,
    CAPACITY,
    ECHO,
    INFRARED,
    LAST_BURST,
    LEDS,
    N_BOARD,
    N_ECHO,
    N_MOMENTS,
    N_ULTRASONIC,
    N_VEHICLE,
    NONE,
    Khepera3State,
)
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.robot_arrays import Layout, Part, read
from khep_twin.simulation.world_state import POSITIONS, RobotSnapshot

_WORD = 2**31


LAYOUT = Layout(
    1,
    {
        "memory": [Part("byte of the motor controllers", 2 * N_BYTES, 0, 255)],
        "controllers": [Part("number of the motor controllers", 2 * N_MOTOR)],
        "counts": [Part("pulses of an encoder", 2)],
        "board": [
            Part("flag of the supply", 1, 0, 1),
            Part("time of the dsPIC", 2),
            Part("last ultrasonic sensor", 1, NONE, N_ULTRASONIC - 1),
            Part("flag of bursts", 1, 0, 1),
            Part("state of an LED", 2, 0, 1),
            Part("setting", N_BOARD - LEDS - 2, 0, 0xFFFF),
        ],
        "echoes": [Part("ultrasonic reading", N_ULTRASONIC * N_ECHO)],
        "battery": [Part("used charge", 1, 0, CAPACITY), Part("current", 2)],
        "vehicle": [Part("number of the vehicle", N_VEHICLE, -_WORD, _WORD)],
        "registers": [Part("register", SAMPLED[-1].registers[-1] + 1)],
    },
)
"""State of the robot in snapshots, besides the positions at the last burst."""

_BATTERY_EMPTY = "the battery is empty: the robot stands still"


class Khepera3Robot(Robot):
    """A Khepera III of a world.

    Args:
        setup: See `Robot`.

    Attributes:
        bus: Its devices.
        registers: Values of `SAMPLED` at the last `refresh`.
    """

    firmware: Letters
    sampled = SAMPLED
    layout = LAYOUT

    def __init__(self, setup: RobotSetup) -> None:
        context, entry = setup.context, setup.context.playpen.robots[setup.index]
        self._state: Khepera3State = context.simulation.robots.state_of(setup.index)
        self.bus = Bus(self._state, version_of(entry.robot_model))
        super().__init__(setup, Letters(self.bus, self._state.vehicle, entry.rom))
        self.bus.dspic.before_read = self._evaluate_pending
        self.bus.dspic.time_ms = lambda: context.time_ns // 1_000_000
        self.registers = self._record["registers"]
        context.observers.evaluations.append(self.refresh)

    def act_after(self, reason: int) -> None:
        """Update faults before a control period, and act after it if the stepping core has asked for it."""
        super().act_after(reason)
        if reason == step.Reason.TICKED and self.bus.dspic.is_powered:
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
        self._evaluate_pending("N")
        self._evaluate_pending("G")
        fill_registers(self._state)

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        self.refresh()
        snapshot, positions = super().state(since_ns), b""
        if self._state.board[LAST_BURST] != NONE:
            positions = self._burst_positions.tobytes()
        return snapshot._replace(arrays={**snapshot.arrays, POSITIONS: positions})

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        arrays, time_ns = dict(state.arrays), self._context.time_ns
        positions = arrays.pop(POSITIONS, b"")
        super().set_state(state._replace(arrays=arrays))
        if (powered := int(self.bus.dspic.is_powered)) == state.is_stopped:
            raise ValueError(f"board: powered = {powered}; expected {1 - powered}")
        for moment in range(N_MOMENTS):
            self._state.times[moment] = NONE
        has_burst = self._state.board[LAST_BURST] != NONE
        part = Part("joint's position", len(self._context.data.qpos) if has_burst else 0)
        numbers = read(POSITIONS, positions, [part], is_float=True)
        if has_burst:
            self._burst_positions[:] = numbers
            self._state.times[BURST] = time_ns // BURST_NS * BURST_NS

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        return [int(led) for led in self._state.board[LEDS : LEDS + 2]]

    def reset_motion(self) -> None:
        """Reset the motor controllers, and cut the motors' voltage."""
        for side, motor in enumerate(self.bus.motors):
            motor.enter(Mode.RESET)
            self._state.counts[side] = wheel_pulses(
                self._state, self._context.data.qpos[self.indices.wheel_qpos[side]]
            )
        self._context.data.ctrl[list(self.indices.motors)] = 0.0

    @property
    def _burst_positions(self) -> NDArray[np.float64]:
        """Positions of all joints at the last burst."""
        row = self._context.moments.rows[self._state.first_moment + BURST]
        return row[: len(self._context.data.qpos)]

    def _evaluate_pending(self, letter: str) -> None:
        """Evaluate the pending measurements that a command reads, by its letter."""
        moments = range(ECHO, N_MOMENTS) if letter == "G" else (INFRARED,) if letter in "NO" else ()
        for moment in moments:
            if self._state.times[moment] != NONE:
                number = self._state.first_moment + moment
                self._context.simulation.evaluate(self.index, moment, number, self._context.moments)
