"""A Khepera or Khepera II of a world: its registers, turrets, supply and faults."""

from khep_twin import step, units
from khep_twin.board import kernel
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL
from khep_twin.board.kernel import (
    AMBIENT,
    DUTIES,
    LEFT,
    PROXIMITY,
    RIGHT,
    SETPOINTS,
    SPEEDS,
    Board,
    Wheel,
)
from khep_twin.board.turrets import find_turrets
from khep_twin.firmware import Firmware
from khep_twin.robots.khepera import core
from khep_twin.robots.model import SampledRegisters
from khep_twin.robots.robot import Robot, RobotSetup
from khep_twin.simulation.robot_arrays import Layout, Part
from khep_twin.units import SENSOR_LABELS

_LEDS = (int(Board.LED_0), int(Board.LED_1))
_SENSOR_LABELS, _WHEEL_LABELS = ", ".join(SENSOR_LABELS), "left, right, setpoint left, setpoint right"

SAMPLED = (
    SampledRegisters("proximity", f"{_SENSOR_LABELS} [counts]", PROXIMITY),
    SampledRegisters("ambient", f"{_SENSOR_LABELS} [counts]", AMBIENT),
    SampledRegisters("speed", f"{_WHEEL_LABELS} [pulses/10 ms]", (*SPEEDS, *SETPOINTS)),
    SampledRegisters("duty", "left, right [-255 to 255]", DUTIES),
    SampledRegisters("leds", "lateral, frontal [1 is lit]", _LEDS),
)
"""Channels of the board's registers."""

LAYOUT = Layout(
    2,
    {
        "registers": [Part("register", kernel.N_REGISTERS)],
        "processor": [Part("flag of the processor", kernel.N_PROCESSOR, 0, 1)],
        "voltage": [Part("voltage", 1)],
    },
)
"""State of the board in snapshots."""


class KheperaRobot(Robot):
    """A Khepera or Khepera II, whose board the stepping core runs.

    Args:
        setup: See `Robot`.

    Attributes:
        registers: State of the board (N_REGISTERS,).
    """

    firmware: Firmware
    sampled = SAMPLED
    layout = LAYOUT

    def __init__(self, setup: RobotSetup) -> None:
        context, index = setup.context, setup.index
        entry, record = context.playpen.robots[index], context.simulation.robots.record_of(index)
        turrets = {kind: kind.make() for kind in find_turrets(entry.turrets)}
        firmware = Firmware(entry.firmware, entry.mode, turrets, record["registers"], record["processor"])
        super().__init__(setup, firmware)
        self.registers = firmware.registers
        self._register_view = firmware.register_view

    def act_after(self, reason: int) -> None:
        """React to the reason for which the stepping core has returned.

        Args:
            reason: `STEPPED` for faults of conversions, `TICKED` to run the turrets and for other faults,
                `STOPPED` to complete the stop of a processor with a low supply voltage.
        """
        if reason == step.Reason.STEPPED:
            self.update_faults(SENSOR)
        elif reason == step.Reason.TICKED:
            self._run_turrets()
            simulation = self._context.simulation
            for fault in self.update_faults(MOTOR, WHEEL, ""):
                if fault.device == MOTOR:  # from the next control period on the stepping core does this
                    core.drive(simulation.plain.scene, simulation.robots.state_of(self.index), fault.which)
        elif reason == step.Reason.STOPPED and not self.firmware.powered and not self._has_stopped:
            self._has_stopped = True
            self.stop_processor()
            message = (
                f"the supply fell to {self._record['voltage'][0]:.2f} V: the processor stands still, "
                "the motors keep their duty"
            )
            self._context.observers.on_event(self.index, message)

    @property
    def lit_leds(self) -> list[int]:
        """State of each LED in the registers, 0 for off."""
        return [self._register_view[led] for led in _LEDS]

    def reset_motion(self) -> None:
        """Reset counters, setpoints, controllers and LEDs, and cut the motors' voltage."""
        kernel.reset(self._register_view)
        self._context.data.ctrl[list(self.indices.motors)] = 0.0
        angles = self._context.data.qpos[list(self.indices.wheel_qpos)].tolist()
        self.registers[[LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]] = [*map(units.wheel_pulses, angles)]

    def _run_turrets(self) -> None:
        """Run one control period of the turrets."""
        for body in self.turret_bodies.values():
            body.sense()
        self.firmware.tick_turrets()
        for body in self.turret_bodies.values():
            body.drive()
