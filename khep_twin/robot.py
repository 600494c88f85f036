"""One robot of a world: its board, line, turrets, supply, and body in the physics."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from khep_twin import step, units
from khep_twin.board import kernel
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL, Fault, Injector
from khep_twin.board.kernel import LEFT, RIGHT, Board, Wheel
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find
from khep_twin.firmware import Firmware
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.faulty_wheels import FaultyWheels
from khep_twin.simulation.turret_place import TurretPlace, TurretWorld
from khep_twin.simulation.wired_board import LineWorld, WiredBoard
from khep_twin.simulation.world_state import BoardState, RobotSnapshot


class WorldContext(TurretWorld, LineWorld, Protocol):
    """Interface of the world to its robots."""

    def on_event(self, robot: int | None, text: str) -> None:
        """Log an event."""
        ...


class RobotSettings(NamedTuple):
    """Settings of a world's robots.

    Attributes:
        unpaced: True for lines without delay.
        strict_line: True to garble the bytes between a robot and a host whose line has another speed.
        faults: Faults of the robots.
    """

    unpaced: bool
    strict_line: bool
    faults: tuple[Fault, ...]


_RECORDED = ("registers", "processor", "sensor_states", "strengths", "voltage")
"""Fields of a robot's record that change in a run."""


class Robot(WiredBoard):
    """One robot of a world: its board, its line and its body in the physics.

    Attributes:
        index: Index among the playpen's robots.
        name: Name in the scene, e.g. "khepera0".
        indices: Indices in the scene.
        firmware: Command interpreter.
        uart: Serial line.
        faults: Its faults.
        registers: State of the board (N_REGISTERS,).
        turret_bodies: Bodies of its turrets, by their names.
    """

    def __init__(
        self,
        context: WorldContext,
        index: int,
        indices: RobotIndices,
        state: NDArray[np.void],
        rng: Callable[..., np.random.Generator],
        settings: RobotSettings,
    ) -> None:
        model, data = context.model, context.data
        entry = context.playpen.robots[index]
        self.name = f"khepera{index}"
        turrets = {kind: kind.make() for kind in find(entry.turrets)}
        super().__init__(
            context,
            index,
            Firmware(ROMS[entry.rom], entry.mode, turrets, state["registers"], state["processor"]),
            Injector(settings.faults, partial(rng, "fault"), partial(context.on_event, index)),
            settings.unpaced,
            rng("line") if settings.strict_line else None,
        )
        self._state, self._context = state, context
        self.fit_turrets()
        self.registers = self.firmware.registers
        self._register_view = self.firmware.register_view
        self._has_stopped = False
        self.indices = indices
        positions = [model.body_pos[light] for light in self.indices.led_lights]
        hidden: list[NDArray[np.float64]] = [position.copy() for position in positions]
        self._lights = list(zip(positions, hidden, model.site_pos[list(self.indices.leds)], strict=True))
        self._shown = [0] * len(_LEDS)
        self._wheels = None
        if any(fault.device == WHEEL for fault in settings.faults):
            self._wheels = FaultyWheels(model, data, indices)

    def fit_turrets(self) -> None:
        """Give its turrets their bodies in the scene as it is now; their state is in their registers."""
        self.turret_bodies = {
            kind.name: kind.fit(TurretPlace(self._context, self.index, kind, turret.registers, self._state))
            for kind, turret in self.firmware.turrets.items()
            if kind.fit is not None
        }

    def state(self, since_ns: int = -1) -> RobotSnapshot:
        """Return the state, with the replies that reach the host after a time [ns]."""
        recorded: dict[str, Any] = {name: self._state[name].tobytes() for name in _RECORDED}
        return RobotSnapshot(
            **self.board_state(since_ns)._asdict(),
            **recorded,
            stopped=self._has_stopped,
            leds=(self._shown[0], self._shown[1]),
        )

    def set_state(self, state: RobotSnapshot) -> None:
        """Take over a state.

        Raises:
            ValueError: It is of another robot, or another line.
        """
        for name in _RECORDED:
            field, data = self._state[name], getattr(state, name)
            if len(data) != field.nbytes:
                raise ValueError(f"{len(data)} bytes of {name}; expected {field.nbytes}")
            field[:] = np.frombuffer(data, field.dtype)
        self.set_board_state(BoardState(*(getattr(state, name) for name in BoardState._fields)))
        self._has_stopped = state.stopped
        self._show(state.leds)
        self.apply_faults()

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        return self.indices.pose_in(self._context.data.qpos)

    @property
    def line_image(self) -> NDArray[np.int64] | None:
        """Greys that its turret sees, from the left to the right, 0 to 255 (n,); None without such one."""
        for kind, turret in self.firmware.turrets.items():
            if kind.image is not None:
                return turret.registers[kind.image]
        return None

    @property
    def disc(self) -> tuple[float, float, float]:
        """Disc of the floor that it covers: x, y and radius [m]."""
        x, y, _ = self.pose
        return x, y, float(self._state["radius"])

    def act_after(self, reason: int) -> None:
        """Do what the stepping core has returned for.

        Args:
            reason: `step.STEPPED` for faults of conversions, TICKED to run the turrets and for other faults,
                STOPPED to complete the stop of a processor whose supply is too low.
        """
        if reason == step.STEPPED:
            if self.faults.update((SENSOR,), self._context.time_ns):
                self.apply_faults()
        elif reason == step.TICKED:
            self._run_turrets()
            self._fail()
        elif reason == step.STOPPED and not self.firmware.powered and not self._has_stopped:
            self._has_stopped = True
            self.stop_processor()
            text = (
                f"the supply fell to {self._state['voltage'][0]:.2f} V: the processor stands still, "
                "the motors keep their duty"
            )
            self._context.on_event(self.index, text)

    @property
    def next_faults_ns(self) -> list[int]:
        """Times at which faults begin or end by themselves [ns]."""
        return self.faults.next_changes_ns

    def apply_faults(self) -> None:
        """Make sensors, motors and wheels as the present faults have them; sound without any."""
        sensors, strengths, wheels = self._state["sensor_states"], self._state["strengths"], self._wheels
        sensors[:], strengths[:] = step.SOUND, 1
        if wheels is not None:
            wheels.mend()
        for fault in self.faults.active:
            if fault.device == SENSOR:
                state = step.DEAD if fault.kind == "dead" else step.STUCK
                sensors[fault.which] = max(sensors[fault.which], state)
            elif fault.device == MOTOR:
                strengths[fault.which] = min(strengths[fault.which], fault.part)
            elif wheels is not None and fault.kind == "slip":
                wheels.slip(fault.which, fault.part)
            elif wheels is not None and fault.device == WHEEL:
                wheels.block(fault.which)

    @property
    def leds_differ(self) -> bool:
        """True if the lights do not show what the LEDs' registers say yet."""
        return [self._register_view[led] for led in _LEDS] != self._shown

    def show_leds(self) -> None:
        """Move the lights of lit LEDs to the LEDs, those of unlit ones back into the body."""
        self._show([self._register_view[led] for led in _LEDS])

    def _show(self, leds: Sequence[int]) -> None:
        self._shown = list(leds)
        for lit, (place, hidden, shown) in zip(self._shown, self._lights, strict=True):
            place[:] = shown if lit else hidden

    def reset_motion(self) -> None:
        """Reset counters, setpoints, controllers and LEDs, and cut the motors' voltage."""
        kernel.reset(self._register_view)
        self.zero_encoders()
        self._context.data.ctrl[list(self.indices.motors)] = 0.0

    def zero_encoders(self) -> None:
        """Set the encoders to the wheels' current angles."""
        angles = self._context.data.qpos[list(self.indices.wheel_angles)].tolist()
        self.registers[[LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]] = [*map(units.wheel_pulses, angles)]

    def _run_turrets(self) -> None:
        """Run one control period of the turrets."""
        for body in self.turret_bodies.values():
            body.sense()
        self.firmware.tick_turrets()
        for body in self.turret_bodies.values():
            body.drive()

    def _fail(self) -> None:
        """Begin and end the faults of a control period."""
        time_ns, data, state = self._context.time_ns, self._context.data, self._state
        changed = self.faults.update((MOTOR, WHEEL, ""), time_ns)
        if changed:
            self.apply_faults()
        for which in {fault.which for fault in changed if fault.device == MOTOR}:
            # From the next control period on the stepping core does this.
            voltage = units.duty_voltage(self.registers[kernel.DUTIES[which]], state["voltage"][0])
            if state["strengths"][which] != 1:
                speed = data.qvel[self.indices.wheel_speeds[which]]
                constant = float(state["motor_constant"])
                voltage = step.weak_voltage(state["strengths"][which], voltage, constant, speed)
            data.ctrl[self.indices.motors[which]] = voltage
        if any(fault.kind == "brown-out" for fault in changed):
            self.reset_processor()


_LEDS = (int(Board.LED_0), int(Board.LED_1))
