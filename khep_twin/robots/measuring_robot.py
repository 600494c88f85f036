"""Robot of a world whose measurements are evaluated when a program, a log or its line reads them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from khep_twin import step
from khep_twin.robots.line_server import VehicleServer
from khep_twin.robots.measuring_core import BURST, ECHO, INFRARED, NONE
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.sensing.buffers import RobotState
from khep_twin.simulation.robot_arrays import Part, read
from khep_twin.simulation.world_state import POSITIONS, RobotSnapshot

_BATTERY_EMPTY = "the battery is empty: the robot stands still"


class MeasuringRobot(Robot):
    """A robot whose state has the moments of `measuring_core`.

    Args:
        setup: See `Robot`.
        firmware: Program on its line.
        fill_registers: Function that sets the registers of a state.
        burst_ns: Time from one burst to the next [ns].
    """

    firmware: VehicleServer

    def __init__(
        self,
        setup: RobotSetup,
        firmware: VehicleServer,
        fill_registers: Callable[[RobotState], None],
        burst_ns: int,
    ) -> None:
        super().__init__(setup, firmware)
        self._state: RobotState = setup.context.simulation.robots.state_of(setup.index)
        self._fill_registers, self._burst_ns = fill_registers, burst_ns
        self.registers = self._record["registers"]
        setup.context.observers.evaluations.append(self.refresh)

    def evaluate_all(self) -> None:
        """Evaluate all pending measurements."""
        self._evaluate(INFRARED)
        self._evaluate_echoes()

    def act_after(self, reason: int) -> None:
        """Update faults before a control period, and act after it if the stepping core has asked for it."""
        super().act_after(reason)
        if reason == step.Reason.TICKED and self.firmware.powered:
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
        self.evaluate_all()
        self._fill_registers(self._state)

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        self.evaluate_all()
        snapshot = super().state(since_ns)
        positions = self._burst_positions.tobytes() if self._state.burst[0] != NONE else b""
        return snapshot._replace(arrays={**snapshot.arrays, POSITIONS: positions})

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        arrays = dict(state.arrays)
        positions = arrays.pop(POSITIONS, b"")
        super().set_state(state._replace(arrays=arrays))
        if (powered := int(self.firmware.powered)) == state.is_stopped:
            raise ValueError(f"powered = {powered}; expected {1 - powered}")
        for moment in range(len(self._state.times)):
            self._state.times[moment] = NONE
        has_burst = self._state.burst[0] != NONE
        part = Part("joint's position", len(self._context.data.qpos) if has_burst else 0)
        numbers = read(POSITIONS, positions, [part], is_float=True)
        if has_burst:
            self._burst_positions[:] = numbers
            self._state.times[BURST] = self._context.time_ns // self._burst_ns * self._burst_ns

    @property
    def _burst_positions(self) -> NDArray[np.float64]:
        """Positions of all joints at the last burst."""
        row = self._context.moments.rows[self._state.first_moment + BURST]
        return row[: len(self._context.data.qpos)]

    def _evaluate_echoes(self) -> None:
        """Evaluate the pending bursts of the ultrasonic sensors."""
        self._evaluate(*range(ECHO, len(self._state.times)))

    def _evaluate(self, *moments: int) -> None:
        """Evaluate those of these moments of the robot that are pending."""
        for moment in moments:
            if self._state.times[moment] != NONE:
                number = self._state.first_moment + moment
                self._context.simulation.evaluate(self.index, moment, number, self._context.moments)
