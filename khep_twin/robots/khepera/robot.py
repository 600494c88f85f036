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
from khep_twin.simulation.faulty_wheels import FaultyWheels
from khep_twin.simulation.robot_arrays import Layout, Part
from khep_twin.simulation.world_state import RobotSnapshot
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
    1,
    {
        "registers": [Part("register", kernel.N_REGISTERS)],
        "processor": [Part("flag of the processor", kernel.N_PROCESSOR, 0, 1)],
        "sensor_states": [Part("state of a sensor", units.N_SENSORS, core.SOUND, core.DEAD)],
        "strengths": [Part("part of a motor's torque", 2, 0, 1)],
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
    fault_devices = (SENSOR, MOTOR, WHEEL)

    def __init__(self, setup: RobotSetup) -> None:
        context, index = setup.context, setup.index
        entry, record = context.playpen.robots[index], context.simulation.robots.record_of(index)
        turrets = {kind: kind.make() for kind in find_turrets(entry.turrets)}
        firmware = Firmware(entry.firmware, entry.mode, turrets, record["registers"], record["processor"])
        super().__init__(setup, firmware)
        self.registers = firmware.registers
        self._register_view = firmware.register_view
        self._wheels = None
        if any(fault.device == WHEEL for fault in setup.faults):
            self._wheels = FaultyWheels(context.model, context.data, setup.indices)

    def set_state(self, state: RobotSnapshot) -> None:
        """Restore a state."""
        super().set_state(state)
        self.apply_faults()

    def act_after(self, reason: int) -> None:
        """React to the reason for which the stepping core has returned.

        Args:
            reason: `STEPPED` for faults of conversions, `TICKED` to run the turrets and for other faults,
                `STOPPED` to complete the stop of a processor with a low supply voltage.
        """
        if reason == step.Reason.STEPPED:
            if self.faults.update((SENSOR,), self._context.time_ns):
                self.apply_faults()
        elif reason == step.Reason.TICKED:
            self._run_turrets()
            self._update_faults()
        elif reason == step.Reason.STOPPED and not self.firmware.powered and not self._has_stopped:
            self._has_stopped = True
            self.stop_processor()
            message = (
                f"the supply fell to {self._record['voltage'][0]:.2f} V: the processor stands still, "
                "the motors keep their duty"
            )
            self._context.observers.on_event(self.index, message)

    def apply_faults(self) -> None:
        """Apply the active faults to sensors, motors and wheels; without faults, restore them."""
        sensors, strengths, wheels = self._record["sensor_states"], self._record["strengths"], self._wheels
        sensors[:] = core.SOUND
        strengths[:] = 1
        if wheels is not None:
            wheels.mend()
        for fault in self.faults.active:
            if fault.device == SENSOR:
                sensor_state = core.DEAD if fault.kind == "dead" else core.STUCK
                sensors[fault.which] = max(sensors[fault.which], sensor_state)
            elif fault.device == MOTOR:
                strengths[fault.which] = min(strengths[fault.which], fault.part)
            elif wheels is not None and fault.kind == "slip":
                wheels.slip(fault.which, fault.part)
            elif wheels is not None and fault.device == WHEEL:
                wheels.block(fault.which)

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

    def _update_faults(self) -> None:
        """Start and end faults in a control period."""
        time_ns, data, record = self._context.time_ns, self._context.data, self._record
        changed_faults = self.faults.update((MOTOR, WHEEL, ""), time_ns)
        if changed_faults:
            self.apply_faults()
        for motor in {fault.which for fault in changed_faults if fault.device == MOTOR}:
            # From the next control period on the stepping core does this.
            voltage = units.duty_voltage(self.registers[kernel.DUTIES[motor]], record["voltage"][0])
            if record["strengths"][motor] != 1:
                speed = data.qvel[self.indices.wheel_dofs[motor]]
                constant = float(record["motor_constant"])
                voltage = core.weak_voltage(record["strengths"][motor], voltage, constant, speed)
            data.ctrl[self.indices.motors[motor]] = voltage
        if any(fault.kind == "brown-out" for fault in changed_faults):
            self.reset_processor()
