"""One robot of a world: its board, line, turrets, supply, and body in the physics."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from khep_twin import step, units
from khep_twin.board import kernel
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL, Fault, Injector
from khep_twin.board.kernel import LEFT, RIGHT, Board, Wheel
from khep_twin.board.protocol import LINE_END
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find
from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings, Uart
from khep_twin.firmware import Firmware
from khep_twin.randomness import position, resume
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.simulation.faulty_wheels import FaultyWheels
from khep_twin.simulation.turret_place import TurretPlace, TurretWorld
from khep_twin.simulation.world_state import HostState, RobotSnapshot

REPLY_LIMIT = 256
"""Bytes of replies queued before the firmware takes no more commands (assumed)."""

_MOST_WARNINGS = 100
"""Most speeds of a host that are reported; a host may try millions."""


class WorldContext(TurretWorld, Protocol):
    """Interface of the world to its robots."""

    def log_event(self, robot: int | None, text: str) -> None:
        """Log an event."""
        ...

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Log bytes on a line, the last of them at `time_ns`."""
        ...

    def on_host_event(self, robot: int, event: HostEvent) -> None:
        """Log a host's action now."""
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


class Robot:
    """One robot of a world: its board, its line and its body in the physics.

    Attributes:
        index: Index among the playpen's robots.
        name: Name in the scene, e.g. "khepera0".
        indices: Indices in the scene.
        firmware: Command interpreter.
        uart: Serial line.
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
        self._state = state
        self.firmware = Firmware(ROMS[entry.rom], entry.mode, turrets, state["registers"], state["processor"])
        self._context = context
        self.index = index
        self.fit_turrets()
        self.registers = self.firmware.registers
        self._register_view = self.firmware.register_view
        self._has_stopped = False
        self.uart = Uart(0 if settings.unpaced else self.firmware.baud)
        self._unpaced = settings.unpaced
        self._baud = self.firmware.baud
        self._host: LineSettings | None = None
        self._warned: set[tuple[int, int]] = set()
        self.indices = indices
        positions = [model.body_pos[light] for light in self.indices.led_lights]
        hidden: list[NDArray[np.float64]] = [position.copy() for position in positions]
        self._lights = list(zip(positions, hidden, model.site_pos[list(self.indices.leds)], strict=True))
        self._shown = [0] * len(_LEDS)
        self._line_noise = rng("line") if settings.strict_line else None
        self._faults = Injector(settings.faults, partial(rng, "fault"), partial(context.log_event, index))
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
        settings = None if self._host is None else (self._host.baud, self._host.stop_bits)
        return RobotSnapshot(
            self.firmware.state(),
            *(self._state[name].tobytes() for name in _RECORDED),
            stopped=self._has_stopped,
            baud=self._baud,
            rx=self.uart.rx.state(),
            tx=self.uart.tx.state(since_ns),
            host=HostState(settings, tuple(sorted(self._warned))),
            leds=(self._shown[0], self._shown[1]),
            faults=self._faults.state(),
            line_noise=None if self._line_noise is None else position(self._line_noise),
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
        if (state.line_noise is None) != (self._line_noise is None):
            raise ValueError(
                f"strict_line = {self._line_noise is None}; expected {self._line_noise is not None}"
            )
        if self._line_noise is not None and state.line_noise is not None:
            resume(self._line_noise, state.line_noise)
        self.firmware.set_state(state.firmware)
        self.uart.rx.set_state(state.rx)
        self.uart.tx.set_state(state.tx)
        self._faults.set_state(state.faults)
        self._has_stopped, self._baud = state.stopped, state.baud
        self._host = None if state.host.settings is None else LineSettings(*state.host.settings)
        self._warned = set(state.host.warned)
        self._show(state.leds)
        self.apply_faults()

    def reseed(self, rng: Callable[..., np.random.Generator]) -> None:
        """Draw from other random streams of line and faults from now on."""
        if self._line_noise is not None:
            self._line_noise = rng("line")
        self._faults.reseed(partial(rng, "fault"))

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

    def compare_line(self, host: LineSettings | None) -> str:
        """Set the host's end of the line; None for the robot's own settings.

        A host's bytes cross at the host's speed. If it differs from the robot's, bytes arrive unchanged, or
        garbled in both directions on a strict line.

        Returns:
            Warning of a different speed; empty if the speeds agree or the warning was given before. The
            robot accepts one stop bit as well as two.
        """
        is_new, self._host, baud = host is not self._host and host != self._host, host, self._baud
        differs = host is not None and host.baud != baud and (host.baud, baud) not in self._warned
        warns = differs and len(self._warned) < _MOST_WARNINGS
        if is_new or warns:
            self._context.on_host_event(self.index, HostEvent(HostEventKind.SET, self._context.time_ns, host))
        if not warns or host is None:
            return ""
        self._warned.add((host.baud, baud))
        outcome = "taken all the same" if self._line_noise is None else "garbled"
        return (
            f"the host has its line at {host.baud} baud, the robot's has {baud}; the bytes are {outcome}; "
            f"{self.firmware.remedy(host.baud)}"
        )

    def send(self, data: bytes, time_ns: int = 0) -> None:
        """Send bytes of the host, now or at a later time [ns]."""
        time_ns = max(time_ns, self._context.time_ns)
        self._context.on_host_event(self.index, HostEvent(HostEventKind.SEND, time_ns, self._host, data))
        if not self._unpaced:
            self.uart.rx.baud = (self._host and self._host.baud) or self._baud
        self.uart.rx.put(self._over_the_line(data, time_ns), time_ns)
        if self._unpaced:
            # Where no time passes the order of sending and answering is that of the host's actions alone.
            self.exchange(self._context.time_ns)

    def flush(self) -> None:
        """Drop the host's bytes that have not reached the robot yet."""
        self._context.on_host_event(
            self.index, HostEvent(HostEventKind.FLUSH, self._context.time_ns, self._host)
        )
        self.uart.rx.flush(self._context.time_ns)

    def disconnect(self) -> None:
        """Disconnect the host: execute its whole commands without replies, and drop an incomplete one."""
        time_ns = self._context.time_ns
        self._context.on_host_event(self.index, HostEvent(HostEventKind.DISCONNECT, time_ns, self._host))
        rx, tx = self.uart.rx, self.uart.tx
        if sent := rx.read(rx.arrival(len(rx)) or time_ns):
            self._context.on_bytes(time_ns, self.index, True, sent)
            self.firmware.receive(sent)
            self._take_speed(self.firmware.baud)
        self.firmware.forget_line()
        tx.read(time_ns)
        for line in (rx, tx):
            line.flush(time_ns)

    def next_command_ns(self) -> int | None:
        """Return the time when the firmware takes the next whole command [ns], None without one on the line.

        It has arrived then, and at most REPLY_LIMIT bytes of replies are still to be sent.
        """
        command = self._next_command()
        return command and command[1]

    def next_exchange_ns(self) -> int | None:
        """Return the earliest time for which `exchange` has something to do [ns], None for an empty line."""
        if (first_ns := self.uart.rx.next_ns) is None:
            return None
        return first_ns if (command := self._next_command()) is None else command[1]

    def next_answer_ns(self) -> int | None:
        """Return the earliest time of the firmware's next output [ns], None if none is due.

        A command causes a reply, and a brown-out fault the banner.
        """
        command_ns = self.next_command_ns()
        brown_out_ns = self._faults.next_brown_out_ns()
        if brown_out_ns is None or not self.firmware.powered:
            return command_ns
        # Faults happen in control ticks, the next of them for a fault added to a run that was past its time.
        next_tick = self._context.time_ns // units.TICK_NS + 1
        tick_ns = units.TICK_NS * max(-(-brown_out_ns // units.TICK_NS), next_tick)
        return tick_ns if command_ns is None else min(command_ns, tick_ns)

    def exchange(self, time_ns: int) -> None:
        """Pass the bytes that arrive by `time_ns` to the firmware and send its replies."""
        rx = self.uart.rx
        while (command := self._next_command()) is not None and command[1] <= time_ns:
            count, taken_ns = command
            line = rx.read(taken_ns, count)
            self._context.on_bytes(taken_ns, self.index, True, line)
            answer = self.firmware.receive(line)
            # A restart sets the speed before its banner, the tool `serial` after its reply.
            self._take_speed(self.firmware.reply_baud)
            if answer:
                self._reply(answer, taken_ns)
            self._take_speed(self.firmware.baud)
        # The bytes of an incomplete command are read at once; a whole one that waits stays whole.
        if command is None and (count := rx.arrived(time_ns)):
            arrival_ns = rx.arrival(count) or time_ns
            begun = rx.read(time_ns)
            self._context.on_bytes(arrival_ns, self.index, True, begun)
            self.firmware.receive(begun)

    def act_after(self, reason: int) -> None:
        """Do what the stepping core has returned for.

        Args:
            reason: `step.STEPPED` for faults of conversions, TICKED to run the turrets and for other faults,
                STOPPED to complete the stop of a processor whose supply is too low.
        """
        if reason == step.STEPPED:
            if self._faults.update((SENSOR,), self._context.time_ns):
                self.apply_faults()
        elif reason == step.TICKED:
            self._run_turrets()
            self._fail()
        elif reason == step.STOPPED and not self.firmware.powered and not self._has_stopped:
            self._has_stopped = True
            self.firmware.forget()
            self.uart.tx.flush(self._context.time_ns)
            text = (
                f"the supply fell to {self._state['voltage'][0]:.2f} V: the processor stands still, "
                "the motors keep their duty"
            )
            self._context.log_event(self.index, text)

    @property
    def next_faults_ns(self) -> list[int]:
        """Times at which faults begin or end by themselves [ns]."""
        return self._faults.next_changes_ns

    def apply_faults(self) -> None:
        """Make sensors, motors and wheels as the present faults have them; sound without any."""
        sensors, strengths, wheels = self._state["sensor_states"], self._state["strengths"], self._wheels
        sensors[:], strengths[:] = step.SOUND, 1
        if wheels is not None:
            wheels.mend()
        for fault in self._faults.active:
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

    def _next_command(self) -> tuple[int, int] | None:
        """Return the length of the next whole command on the line and when it is taken [ns]; None without."""
        rx, tx = self.uart.rx, self.uart.tx
        if rx.next_ns is None or (count := rx.count_to(LINE_END)) is None:
            return None
        room_ns = tx.arrival(len(tx) - REPLY_LIMIT) if len(tx) > REPLY_LIMIT else None
        return count, max(rx.arrival(count) or 0, room_ns or 0)

    def _reply(self, answer: bytes, time_ns: int) -> None:
        """Send a reply."""
        time_ns += self._faults.delay_ns(time_ns)
        answer = self._over_the_line(answer, time_ns)
        self._context.on_bytes(self.uart.tx.put(answer, time_ns), self.index, False, answer)

    def _take_speed(self, baud: int) -> None:
        """Set the robot's end of the line to a speed of the firmware."""
        self._baud = baud
        if not self._unpaced:
            self.uart.tx.baud = baud

    def _over_the_line(self, data: bytes, time_ns: int) -> bytes:
        """Return the bytes as they arrive at the other end of the cable."""
        mismatched = self._host is not None and self._host.baud != self._baud
        if mismatched and self._line_noise is not None:
            errors = self._line_noise.integers(1, 256, len(data)).tolist()
            data = bytes(byte ^ error for byte, error in zip(data, errors, strict=True))
        return self._faults.over_the_line(data, time_ns)

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
        changed = self._faults.update((MOTOR, WHEEL, ""), time_ns)
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
        brown_out = any(fault.kind == "brown-out" for fault in changed)
        if brown_out and (banner := self.firmware.reset()):
            self._take_speed(self.firmware.reply_baud)
            self._reply(banner, time_ns)


_LEDS = (int(Board.LED_0), int(Board.LED_1))
