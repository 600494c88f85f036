"""One robot of a world: its board, line, turrets, supply, and body in the physics."""

from collections.abc import Sequence
from functools import partial
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import units
from khep_twin.board import kernel
from khep_twin.board.battery import Supply
from khep_twin.board.fault_injection import Fault, Injector
from khep_twin.board.kernel import DUTIES, LEFT, RIGHT, Board, Wheel
from khep_twin.board.protocol import LINE_END
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find
from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings, Uart
from khep_twin.firmware import Firmware
from khep_twin.playpen import Lighting, Playpen
from khep_twin.randomness import stream
from khep_twin.sensing import calibration
from khep_twin.sensing.ambient import Receivers
from khep_twin.sensing.lamps import Lamps
from khep_twin.sensing.raycast import scene_of
from khep_twin.sensing.robot_indices import RobotIndices
from khep_twin.sensors import InfraredScan

REPLY_LIMIT = 256
"""Bytes of replies queued before the firmware takes no more commands (assumed)."""


_MOST_WARNINGS = 100
"""Most speeds of a host that are reported; a host may try millions."""


class WorldContext(Protocol):
    """Interface of the world to its robots."""

    playpen: Playpen
    model: mujoco.MjModel
    data: mujoco.MjData
    lamps: Lamps
    time_ns: int

    def log_event(self, robot: int | None, text: str) -> None:
        """Log an event."""
        ...

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Log bytes on a line, the last of them at `time_ns`."""
        ...

    def on_host_event(self, robot: int, event: HostEvent) -> None:
        """Log a host's action now."""
        ...


class Robot:
    """One robot of a world: its board, its line and its body in the physics.

    Attributes:
        index: Index among the playpen's robots.
        name: Name in the scene, e.g. "khepera0".
        indices: Indices in the scene.
        firmware: Command interpreter.
        uart: Serial line.
        registers: State of the board (N_REGISTERS,).
    """

    def __init__(
        self,
        context: WorldContext,
        index: int,
        *,
        seed: int,
        noise: bool,
        unpaced: bool,
        strict_line: bool,
        vary: bool,
        faults: Sequence[Fault],
    ) -> None:
        model, data = context.model, context.data
        entry = context.playpen.robots[index]
        self.name = f"khepera{index}"
        turrets = {kind: kind.make() for kind in find(entry.turrets)}
        self.firmware = Firmware(ROMS[entry.rom], entry.mode, turrets)
        self._turret_bodies = [
            kind.fit(model, data, f"{self.name}/{kind.name}/", turret.registers)
            for kind, turret in turrets.items()
            if kind.fit is not None
        ]
        self.registers = self.firmware.registers
        self._register_view = self.firmware.register_view
        self.uart = Uart(0 if unpaced else self.firmware.baud)
        self._unpaced = unpaced
        self._baud = self.firmware.baud
        self._host: LineSettings | None = None
        self._warned: set[tuple[int, int]] = set()
        self._context = context
        self.index = index
        self._radius = entry.body.radius
        self.indices = RobotIndices.of(model, self.name)
        self._supply = Supply(entry.battery_used_min)
        self._voltage = units.SUPPLY_VOLTAGE
        self._force: NDArray[np.float64] = data.actuator_force
        self._qpos: NDArray[np.float64] = data.qpos
        self._qvel: NDArray[np.float64] = data.qvel
        self._ctrl: NDArray[np.float64] = data.ctrl
        positions = [model.body_pos[light] for light in self.indices.led_lights]
        hidden: list[NDArray[np.float64]] = [position.copy() for position in positions]
        self._lights = list(zip(positions, hidden, model.site_pos[list(self.indices.leds)], strict=True))
        rng = partial(stream, seed, "robot", index)
        self._line_noise = rng("line") if strict_line else None
        self._faults = None
        if faults:
            self._faults = Injector(faults, partial(rng, "fault"), partial(context.log_event, index))
        measured = calibration.read(entry.calibration)[0]
        self._motor_constant = measured.motors.constant
        if vary:
            measured = calibration.varied(measured, rng("spread"))
        lighting = context.playpen.lighting
        self._receivers = Receivers(model, self.indices, measured.ambient, context.lamps, lighting)
        scene = scene_of(model, data, self.indices)
        self._scan = InfraredScan(scene, self.indices, measured, self._receivers, rng if noise else None)

    @property
    def pose(self) -> tuple[float, float, float]:
        """True x, y [m] and heading [rad] in the playpen."""
        return self.indices.pose_in(self._qpos)

    @property
    def disc(self) -> tuple[float, float, float]:
        """Disc of the floor that it covers: x, y and radius [m]."""
        x, y, _ = self.pose
        return x, y, self._radius

    def compare_line(self, host: LineSettings | None) -> str:
        """Set the host's end of the line; None for the robot's own settings.

        A host's bytes cross at the host's speed. If it differs from the robot's, bytes arrive unchanged, or
        garbled in both directions on a strict line.

        Returns:
            Warning of a different speed; empty if the speeds agree or the warning was given before. The
            robot accepts one stop bit as well as two.
        """
        if host is not self._host and host != self._host:
            self._context.on_host_event(self.index, HostEvent(HostEventKind.SET, self._context.time_ns, host))
        self._host, baud = host, self._baud
        if host is None or host.baud == baud or (host.baud, baud) in self._warned:
            return ""
        if len(self._warned) == _MOST_WARNINGS:
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
        return self.uart.rx.next_ns if (command := self._next_command()) is None else command[1]

    def next_answer_ns(self) -> int | None:
        """Return the earliest time of the firmware's next output [ns], None if none is due.

        A command causes a reply, and a brown-out fault the banner.
        """
        command_ns = self.next_command_ns()
        brown_out_ns = None if self._faults is None else self._faults.next_brown_out_ns()
        if brown_out_ns is None or not self.firmware.powered:
            return command_ns
        # Faults happen in control ticks, the first of them one period after the start.
        tick_ns = units.TICK_NS * max(-(-brown_out_ns // units.TICK_NS), 1)
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

    def convert(self, channel: int) -> None:
        """Convert one sensor of the scan."""
        proximity, ambient = self._scan.convert(channel)
        if self._faults is not None and self._faults.stuck(channel, self._context.time_ns):
            proximity, ambient = (
                self._register_view[_PROXIMITY + channel],
                self._register_view[_AMBIENT + channel],
            )
        kernel.convert(self._register_view, proximity, ambient)

    def tick(self) -> None:
        """Run one control period: from encoders to motor voltages."""
        ctrl, register_view = self._ctrl, self._register_view
        left, right = self._wheel_pulses()
        for body in self._turret_bodies:
            body.sense()
        self.firmware.tick(left, right)
        for body in self._turret_bodies:
            body.drive()
        for motor, duty in zip(self.indices.motors, DUTIES, strict=True):
            ctrl[motor] = units.duty_voltage(register_view[duty], self._voltage)
        if self._faults is not None:
            self._fail(self._faults)

    def update_supply(self) -> None:
        """Measure the supply; below its minimum voltage the processor is reset and halts."""
        register_view, time_ns = self._register_view, self._context.time_ns
        self._voltage = self._supply.voltage(time_ns)
        current = units.IDLE_CURRENT
        for motor, duty in zip(self.indices.motors, DUTIES, strict=True):
            current += units.supply_current(register_view[duty], self._force[motor] / self._motor_constant)
        kernel.measure(register_view, units.supply_counts(self._voltage), round(current * 1000))
        if self._voltage < units.PROCESSOR_VOLTAGE and self.firmware.powered:
            self.firmware.brown_out()
            self.uart.tx.flush(time_ns)
            text = (
                f"the supply fell to {self._voltage:.2f} V: the processor stands still, "
                "the motors keep their duty"
            )
            self._context.log_event(self.index, text)

    def show_leds(self) -> None:
        """Move the lights of lit LEDs to the LEDs, those of unlit ones back into the body."""
        for led, (position, hidden, shown) in zip(_LEDS, self._lights, strict=True):
            position[:] = shown if self._register_view[led] else hidden

    def reset_motion(self) -> None:
        """Reset counters, setpoints, controllers and LEDs, and cut the motors' voltage."""
        kernel.reset(self._register_view)
        self.zero_encoders()
        self._ctrl[list(self.indices.motors)] = 0.0

    def relight(self, lamps: Lamps, lighting: Lighting) -> None:
        """Replace the lamps and the law of their light."""
        self._receivers.relight(lamps, lighting)

    def zero_encoders(self) -> None:
        """Set the encoders to the wheels' current angles."""
        self.registers[[LEFT + Wheel.ENCODER, RIGHT + Wheel.ENCODER]] = self._wheel_pulses()

    def _wheel_pulses(self) -> tuple[int, int]:
        left, right = self.indices.wheel_angles
        return units.wheel_pulses(self._qpos[left]), units.wheel_pulses(self._qpos[right])

    def _next_command(self) -> tuple[int, int] | None:
        """Return the length of the next whole command on the line and when it is taken [ns]; None without."""
        rx, tx = self.uart.rx, self.uart.tx
        if rx.next_ns is None or (count := rx.count_to(LINE_END)) is None:
            return None
        room_ns = tx.arrival(len(tx) - REPLY_LIMIT) if len(tx) > REPLY_LIMIT else None
        return count, max(rx.arrival(count) or 0, room_ns or 0)

    def _reply(self, answer: bytes, time_ns: int) -> None:
        """Send a reply."""
        if self._faults is not None:
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
        return data if self._faults is None else self._faults.over_the_line(data, time_ns)

    def _fail(self, faults: Injector) -> None:
        """Apply the faults of a control period."""
        time_ns = self._context.time_ns
        wheels = zip(self.indices.motors, self.indices.wheel_speeds, strict=True)
        for side, (motor, speed) in enumerate(wheels):
            if faults.dead(side, time_ns):
                # The motor's own voltage as a generator: no current, no torque.
                self._ctrl[motor] = self._motor_constant * self._qvel[speed]
        if faults.brown_out(time_ns):
            if banner := self.firmware.reset():
                self._take_speed(self.firmware.reply_baud)
                self._reply(banner, time_ns)


_PROXIMITY, _AMBIENT = int(Board.PROXIMITY), int(Board.AMBIENT)
_LEDS = (int(Board.LED_0), int(Board.LED_1))
