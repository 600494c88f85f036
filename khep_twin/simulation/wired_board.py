"""The board of a robot at its serial line."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import numpy as np

from khep_twin import units
from khep_twin.board.fault_injection import Injector
from khep_twin.board.turrets import Turret, TurretKind
from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings, Uart
from khep_twin.firmware import FirmwareState
from khep_twin.observers import Observers
from khep_twin.randomness import position, resume
from khep_twin.simulation.world_state import HostState, RobotSnapshot

REPLY_LIMIT = 256
"""Bytes of queued replies above which the firmware accepts no further command (assumed)."""

_MAX_WARNINGS = 100
"""Largest number of warnings about baud rates of a host, which may try millions."""


class LineWorld(Protocol):
    """Interface of the world to the serial lines."""

    observers: Observers

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        ...


class BoardFirmware(Protocol):
    """Interface of a command interpreter to its line.

    Attributes:
        turrets: Turrets on top, by their kinds.
        baud: Baud rate for the next reply and later ones.
        reply_baud: Baud rate for the last reply.
        answer_ns: Time until a reply [ns]; unless it is 0, bytes that arrive meanwhile are dropped.
    """

    turrets: Mapping[TurretKind, Turret]
    baud: int
    reply_baud: int
    answer_ns: int

    @property
    def powered(self) -> bool:
        """True if the supply suffices for the processor."""
        ...

    def request_length(self, data: bytearray) -> int:
        """Return how many of the next bytes complete a request; more than their number if they do not."""
        ...

    def receive(self, data: bytes) -> bytes:
        """Read bytes from the line; return the replies to the commands that they complete."""
        ...

    def baud_rate_hint(self, baud: int) -> str:
        """Return how to set the robot's port to a host's baud rate."""
        ...

    def forget_line(self) -> None:
        """Discard the incomplete line."""

    def forget(self) -> None:
        """Clear all that a reset clears, except registers."""

    def reset(self) -> bytes:
        """Reset the board, as at power-up; return the banner."""
        ...

    def state(self) -> FirmwareState:
        """Return the state besides the registers."""
        ...

    def set_state(self, state: Any) -> None:
        """Restore a state, a `FirmwareState`."""


class WiredBoard:
    """Board of a robot at its serial line, without a body.

    Args:
        world: World of the robot.
        index: Index of the robot.
        firmware: Command interpreter.
        faults: Faults of the robot.
        unpaced: True for a line without delay.
        noise: Random stream that garbles bytes if the baud rates differ; None to pass them unchanged.

    Attributes:
        index: Index of the robot.
        firmware: Command interpreter.
        uart: Serial line.
        faults: Faults of the robot.
    """

    def __init__(
        self,
        world: LineWorld,
        index: int,
        firmware: BoardFirmware,
        faults: Injector,
        unpaced: bool,
        noise: np.random.Generator | None,
    ) -> None:
        self.index = index
        self.firmware = firmware
        self.uart = Uart(0 if unpaced else firmware.baud)
        self.faults = faults
        self._world = world
        self._unpaced = unpaced
        self._line_noise: np.random.Generator | None = noise
        self._baud = firmware.baud
        self._host: LineSettings | None = None
        self._warned: set[tuple[int, int]] = set()

    def set_host_line(self, host: LineSettings | None) -> str:
        """Set the line settings of the host; None for those of the robot.

        The host's bytes are transmitted at its baud rate. If that differs from the robot's, bytes arrive
        unchanged, or garbled in both directions on a strict line.

        Returns:
            Warning of a different baud rate; empty if the rates agree or the warning was given before. The
            robot accepts one stop bit as well as two.
        """
        is_new, self._host, baud = host is not self._host and host != self._host, host, self._baud
        is_different = host is not None and host.baud != baud and (host.baud, baud) not in self._warned
        must_warn = is_different and len(self._warned) < _MAX_WARNINGS
        if is_new or must_warn:
            self._send_event(HostEventKind.LINE_SETTINGS, self._world.time_ns)
        if not must_warn or host is None:
            return ""
        self._warned.add((host.baud, baud))
        outcome = "still accepted" if self._line_noise is None else "garbled"
        return (
            f"the host has its line at {host.baud} baud, the robot's has {baud}; the bytes are {outcome}; "
            f"{self.firmware.baud_rate_hint(host.baud)}"
        )

    def send(self, data: bytes, time_ns: int = 0) -> None:
        """Send bytes of the host, now or at a later time [ns]."""
        time_ns = max(time_ns, self._world.time_ns)
        self._send_event(HostEventKind.SEND, time_ns, data)
        if not self._unpaced:
            self.uart.rx.baud = (self._host and self._host.baud) or self._baud
        self.uart.rx.send(self._transmit(data, time_ns), time_ns)
        if self._unpaced:
            # Without delay, the order of commands and replies is that of the host's actions.
            self.exchange(self._world.time_ns)

    def flush(self) -> None:
        """Drop the host's bytes that have not yet reached the robot."""
        self._send_event(HostEventKind.FLUSH, self._world.time_ns)
        self.uart.rx.flush(self._world.time_ns)

    def disconnect(self) -> None:
        """Disconnect the host: execute its complete commands without replies, and drop an incomplete one."""
        time_ns = self._world.time_ns
        self._send_event(HostEventKind.DISCONNECT, time_ns)
        rx, tx = self.uart.rx, self.uart.tx
        if sent := rx.read(rx.arrival_ns(len(rx)) or time_ns):
            self._world.observers.on_bytes(time_ns, self.index, True, sent)
            self.firmware.receive(sent)
            self._set_baud(self.firmware.baud)
        self.firmware.forget_line()
        tx.read(time_ns)
        for line in (rx, tx):
            line.flush(time_ns)

    def next_command_ns(self) -> int | None:
        """Return when the firmware accepts the next command [ns]; None without a complete one on the line.

        It is accepted when its last byte has arrived and at most REPLY_LIMIT bytes of replies are queued.
        """
        command = self._next_command()
        return command and command[1]

    def next_exchange_ns(self) -> int | None:
        """Return the earliest time at which `exchange` must be called [ns]; None for an empty line."""
        if (first_ns := self.uart.rx.next_ns) is None:
            return None
        return first_ns if (command := self._next_command()) is None else command[1]

    def next_answer_ns(self) -> int | None:
        """Return the earliest time of the firmware's next output [ns]; None if none is expected.

        A command causes a reply, and a brown-out fault the banner.
        """
        command_ns = self.next_command_ns()
        brown_out_ns = self.faults.next_brown_out_ns()
        if brown_out_ns is None or not self.firmware.powered:
            return command_ns
        # Faults happen in control ticks; a fault that was added after its time happens in the next one.
        next_tick = self._world.time_ns // units.TICK_NS + 1
        tick_ns = units.TICK_NS * max(-(-brown_out_ns // units.TICK_NS), next_tick)
        return tick_ns if command_ns is None else min(command_ns, tick_ns)

    def exchange(self, time_ns: int) -> None:
        """Pass the bytes that arrive by `time_ns` to the firmware and send its replies."""
        rx = self.uart.rx
        while (command := self._next_command()) is not None and command[1] <= time_ns:
            count, taken_ns = command
            line = rx.read(taken_ns, count)
            self._world.observers.on_bytes(taken_ns, self.index, True, line)
            answer = self.firmware.receive(line)
            # A restart sets the baud rate before its banner, the tool `serial` after its reply.
            self._set_baud(self.firmware.reply_baud)
            if answer:
                answer_ns = taken_ns + self.firmware.answer_ns
                if self.firmware.answer_ns and (dropped := rx.read(answer_ns)):
                    self._world.observers.on_bytes(answer_ns, self.index, True, dropped)
                self._reply(answer, answer_ns)
            self._set_baud(self.firmware.baud)
        # The bytes of an incomplete command are read immediately; a complete command waits as a whole.
        if command is None and (count := rx.count_arrived(time_ns)):
            arrival_ns = rx.arrival_ns(count) or time_ns
            fragment = rx.read(time_ns)
            self._world.observers.on_bytes(arrival_ns, self.index, True, fragment)
            self.firmware.receive(fragment)

    def reset_processor(self) -> None:
        """Reset the firmware, as after a short power failure; its banner follows at its initial baud rate."""
        if banner := self.firmware.reset():
            self._set_baud(self.firmware.reply_baud)
            self._reply(banner, self._world.time_ns)

    def stop_processor(self) -> None:
        """Stop the firmware for lack of supply voltage; incomplete commands and queued replies are lost."""
        self.firmware.forget()
        self.uart.tx.flush(self._world.time_ns)

    def board_state(self, since_ns: int = -1) -> dict[str, Any]:
        """Return the fields of its state in a `RobotSnapshot`, with the replies after a time [ns]."""
        settings = None if self._host is None else (self._host.baud, self._host.stop_bits)
        return {
            "firmware": self.firmware.state(),
            "baud": self._baud,
            "rx": self.uart.rx.state(),
            "tx": self.uart.tx.state(since_ns),
            "host": HostState(settings, tuple(sorted(self._warned))),
            "faults": self.faults.state(),
            "line_noise": None if self._line_noise is None else position(self._line_noise),
        }

    def set_board_state(self, state: RobotSnapshot) -> None:
        """Restore a state.

        Raises:
            ValueError: The state is of another robot, or of another line.
        """
        if (state.line_noise is None) != (self._line_noise is None):
            raise ValueError(
                f"strict_line = {self._line_noise is None}; expected {self._line_noise is not None}"
            )
        if self._line_noise is not None and state.line_noise is not None:
            resume(self._line_noise, state.line_noise)
        self.firmware.set_state(state.firmware)
        self.uart.rx.set_state(state.rx)
        self.uart.tx.set_state(state.tx)
        self.faults.set_state(state.faults)
        self._baud = state.baud
        self._host = None if state.host.settings is None else LineSettings(*state.host.settings)
        self._warned = set(state.host.warned)

    def reseed_line(self, rng: Callable[..., np.random.Generator]) -> None:
        """Use other random streams for line noise and faults."""
        if self._line_noise is not None:
            self._line_noise = rng("line")
        self.faults.reseed(partial(rng, "fault"))

    def _send_event(self, kind: HostEventKind, time_ns: int, data: bytes = b"") -> None:
        """Send an action of the host to the observers."""
        self._world.observers.on_host_event(self.index, HostEvent(kind, time_ns, self._host, data))

    def _next_command(self) -> tuple[int, int] | None:
        """Return length and time of acceptance of the next complete command [ns]; None without one."""
        rx, tx = self.uart.rx, self.uart.tx
        if rx.next_ns is None or (count := self.firmware.request_length(rx.content)) > len(rx):
            return None
        space_ns = tx.arrival_ns(len(tx) - REPLY_LIMIT) if len(tx) > REPLY_LIMIT else None
        return count, max(rx.arrival_ns(count) or 0, space_ns or 0)

    def _reply(self, answer: bytes, time_ns: int) -> None:
        """Send a reply."""
        time_ns += self.faults.delay_ns(time_ns)
        answer = self._transmit(answer, time_ns)
        self._world.observers.on_bytes(self.uart.tx.send(answer, time_ns), self.index, False, answer)

    def _set_baud(self, baud: int) -> None:
        """Set the baud rate of the robot's port."""
        self._baud = baud
        if not self._unpaced:
            self.uart.tx.baud = baud

    def _transmit(self, data: bytes, time_ns: int) -> bytes:
        """Return the bytes that arrive at the other end of the cable."""
        mismatched = self._host is not None and self._host.baud != self._baud
        if mismatched and self._line_noise is not None:
            errors = self._line_noise.integers(1, 256, len(data)).tolist()
            data = bytes(byte ^ error for byte, error in zip(data, errors, strict=True))
        return self.faults.transmit(data, time_ns)
