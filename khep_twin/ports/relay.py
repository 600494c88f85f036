"""A relay between a host and a real robot, which passes and records all bytes with their times.

The relay forwards bytes as they arrive, at the host's baud rate. While it drains, replies to a host that has
left are only recorded, and the next host's bytes wait. It starts draining, for replies to earlier programs.

    forwarding --host leaves, replies are due--> draining --all answered, silence or time-out--> forwarding
"""

# pyserial is not typed.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import re
import select
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import serial

from khep_twin.board.uart import LineSettings
from khep_twin.errors import PORT_FAILURES, PortError
from khep_twin.ports.host_port import HostPort, NoticeLimit
from khep_twin.ports.idle_polls import IdlePolls
from khep_twin.ports.network import address_fault
from khep_twin.ports.serve import LONGEST_WAIT_S, PeriodicFlush
from khep_twin.process.machine import wait_readable
from khep_twin.units import BITS_PER_BYTE

_CHUNK = 1024
"""Most bytes that are forwarded together."""

_POLL_INTERVAL_S = 0.001
"""Interval at which a port that cannot wake the loop is polled [s]."""

_PAUSE_S = 0.02
"""Silence after the last due reply before the next host's bytes are sent [s]."""

_SILENCE_S = 0.5
"""Silence after which due replies count as lost (assumed) [s]."""

_STARTUP_S = 2.0
"""Longest time for which a robot's bytes count as replies to an earlier program (assumed) [s]."""

_LONGEST_REPLY = 2048
"""Bytes of the longest reply, that of `list` [bytes]."""

_MAX_TRANSIT_S = 1.0
"""Longest transit of sent bytes through an adapter's buffer (assumed) [s]."""

_INVALIDATION = b"?\n"
"""End of a line that a host has left unfinished: the robot answers with an error and does not execute it."""

_LAST_LIMIT = _CHUNK - len(_INVALIDATION)
"""Most bytes of a host that has left for which the next one waits: one second at 9600 baud."""


class LineListener(Protocol):
    """A listener on a line, for example a log's `LineRecorder`; it must not delay the line."""

    def on_bytes(self, to_robot: bool, data: bytes) -> None:
        """Handle bytes that cross the line now."""

    def on_event(self, text: str) -> None:
        """Handle an event of the line."""

    def flush(self) -> None:
        """Write all buffered records; called twice a second."""


class Device:
    """Serial port of a robot, opened by pyserial.

    Args:
        url: Device, for example /dev/ttyUSB0, or URL of pyserial.
        baud: Baud rate of the robot's line.

    Attributes:
        url: URL that was opened.
        descriptor: Descriptor for `select`; None where the port has none.

    Raises:
        PortError: The port cannot be opened or is a twin's; also in each method if the port fails.
    """

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        if url.startswith("khep:"):
            raise PortError(f"{url}: a twin needs no relay; expected khep-twin serve PLAYPEN")
        try:
            self._port: Any = serial.serial_for_url(
                url, baud, stopbits=serial.STOPBITS_TWO, timeout=0, exclusive=True
            )
        except PORT_FAILURES as error:
            error_number = getattr(error, "errno", None)
            reason = os.strerror(error_number) if error_number else error
            raise PortError(address_fault(url) or f"{url}: cannot open this port: {reason}") from None
        try:
            self.descriptor: int | None = self._port.fileno()
            self._port.write_timeout = 0
        except OSError:
            # Writes return after sending.
            self.descriptor = None

    def apply_settings(self, host: LineSettings) -> str:
        """Apply the host's line settings to the line; return the notice about it, empty if there is none."""
        stop_bits = serial.STOPBITS_TWO if host.stop_bits == 2 else serial.STOPBITS_ONE
        if not host.baud or (host.baud, stop_bits) == (self._port.baudrate, self._port.stopbits):
            return ""
        try:
            self._port.baudrate, self._port.stopbits = host.baud, stop_bits
        except PORT_FAILURES as error:
            return f"the robot's port cannot follow the host to {host.baud} baud: {error}"
        return f"the line is at {host.baud} baud with {host.stop_bits} stop bits, as the host has set it"

    @property
    def baud(self) -> int:
        """Baud rate of the robot's line."""
        return self._port.baudrate

    def read(self) -> bytes:
        """Return the bytes that have arrived from the robot."""
        with self._converted_failures():
            return self._port.read(_CHUNK if self.descriptor is not None else self._port.in_waiting)

    def write(self, data: bytes) -> int:
        """Send to the robot; return the number of bytes that the port accepted."""
        with self._converted_failures():
            # pyserial retries for ever while there is no room.
            if self.descriptor is not None and not select.select([], [self.descriptor], [], 0)[1]:
                return 0
            return self._port.write(data) or 0

    @property
    def unsent(self) -> int:
        """Number of accepted bytes that the port has not sent yet; 0 if it does not report it."""
        with self._converted_failures():
            return self._port.out_waiting if isinstance(self._port, serial.Serial) else 0

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    @contextmanager
    def _converted_failures(self) -> Generator[None]:
        """Convert failures of the port to a `PortError`."""
        try:
            yield
        except PORT_FAILURES as error:
            raise PortError(f"{self.url}: the robot's port failed: {error}") from error


def relay(
    device: Device,
    port: HostPort,
    listeners: Sequence[LineListener] = (),
    polls: IdlePolls | None = None,
    *,
    stop: Callable[[], bool],
    notify: Callable[[str], None],
) -> None:
    """Relay bytes between a host and a robot until `stop` returns True.

    Args:
        device: Port of the robot.
        port: Port for the host.
        listeners: Listeners on the bytes in both directions, for example a log.
        polls: Polls that the relay sends; None for none.
        stop: Callback that is called once per cycle; True stops the relay.
        notify: Callback for notices to the user.

    Raises:
        PortError: The robot's port failed.
    """

    def report(text: str) -> None:
        notify(f"{port.path}: {text}")
        for listener in listeners:
            listener.on_event(text)

    def on_bytes(to_robot: bool, data: bytes) -> None:
        for listener in listeners if data else ():
            listener.on_bytes(to_robot, data)

    flushes = [PeriodicFlush(listener) for listener in listeners]
    dialogue, notice_limit = _Dialogue(device), NoticeLimit()
    pending, next_host_data = b"", b""
    hold_s = 0.0
    while not stop():
        # The next host's bytes are read while draining, to know that it waits.
        has_room = not next_host_data and (not pending or dialogue.is_draining)
        _wait_for_bytes(device, port, has_room, bool(pending), hold_s)
        # Replies are read before hosts: silence is measured at an empty read, even if this cycle is late.
        reply = dialogue.read()
        on_bytes(False, reply)
        host_output = polls.filter_replies(reply) if polls is not None and reply else reply
        received = port.receive(_CHUNK if has_room else 0, has_room and not pending and dialogue.is_quiet)
        for notice in received.notices:
            report(notice)
        if received.hosts_left:
            host_output = b""
            # The pending bytes are also those of the host that has left.
            on_bytes(True, received.last_data)
            remaining = pending + next_host_data + received.last_data
            pending, next_host_data = dialogue.drop_host(remaining), b""
            on_bytes(True, pending[len(remaining) :])
        if received.data:
            on_bytes(True, received.data)
            next_host_data = received.data
        if next_host_data and dialogue.is_draining and len(pending) > _CHUNK:
            n_dropped = len(pending) - _LAST_LIMIT
            report(f"{n_dropped} bytes of a host that has left were dropped: the next one waits")
            pending = dialogue.drop_host(pending[:_LAST_LIMIT])
        if not dialogue.check_draining(pending) and next_host_data:
            settings = port.settings()
            if settings is not None and (notice := device.apply_settings(settings)):
                for text in notice_limit.admit([notice]):
                    report(text)
            pending, next_host_data = pending + next_host_data, b""
        if polls is not None:
            hold_s = polls.remaining_hold_s(pending)
            if not next_host_data and not pending and dialogue.is_idle:
                on_bytes(True, pending := polls.next_command(device.baud))
        if pending and not hold_s:
            pending = dialogue.send(pending)
        if host_output and port.occupied and not dialogue.is_draining:
            port.write(host_output)
        for flush in flushes:
            flush()


class _Dialogue:
    """State of the line: commands sent and replies due, so that no host gets replies to an earlier one."""

    def __init__(self, device: Device) -> None:
        self.is_draining = True
        self._device = device
        self._n_due = 0
        self._commands, self._replies = _LineCounter(), _LineCounter()
        self._last_read_s = self._last_traffic_s = time.monotonic()
        self._deadline_s = self._last_traffic_s + _STARTUP_S  # a robot may also send bytes unasked

    def send(self, data: bytes) -> bytes:
        """Send to the robot; return the bytes that are still to be sent."""
        n_sent = self._device.write(data[:_CHUNK])
        self._n_due += self._commands.count(data[:n_sent])
        busy_s = n_sent * BITS_PER_BYTE / self._device.baud
        now = time.monotonic()
        self._last_traffic_s = min(max(self._last_traffic_s, now) + busy_s, now + _MAX_TRANSIT_S)
        self._extend_deadline(self._last_traffic_s)
        return data[n_sent:]

    def read(self) -> bytes:
        """Return the bytes that have arrived from the robot, and count their replies."""
        self._last_read_s = time.monotonic()
        if reply := self._device.read():
            n_replies = self._replies.count(reply)
            if self._n_due and n_replies:
                self._n_due = max(self._n_due - n_replies, 0)
                self._extend_deadline(self._last_read_s)
            self._last_traffic_s = max(self._last_traffic_s, time.monotonic())
        elif self._n_due and self.is_quiet:
            self._n_due = 0  # lost replies
        return reply

    def drop_host(self, pending: bytes) -> bytes:
        """Start draining after a host has left; return its unsent bytes, with an end for a partial line."""
        last_byte = (self._commands.partial + pending)[-1:]
        if last_byte and last_byte not in b"\r\n":
            pending += _INVALIDATION
        # Only the first line of a reply of several lines was due.
        if pending or self._n_due or not self.is_quiet:
            self.is_draining = True
            self._extend_deadline(self._last_read_s)
        return pending

    def _extend_deadline(self, since_s: float) -> None:
        """Set the end of draining to a time at which the longest reply would have arrived."""
        since_s += _LONGEST_REPLY * BITS_PER_BYTE / self._device.baud
        self._deadline_s = max(self._deadline_s, since_s + _STARTUP_S)

    @property
    def is_quiet(self) -> bool:
        """True if the line was silent before the last read for so long that no reply is expected."""
        if self._device.unsent:
            self._last_traffic_s = max(self._last_traffic_s, time.monotonic())
        is_expecting = self._n_due or self._replies.partial
        return self._last_read_s - self._last_traffic_s > (_SILENCE_S if is_expecting else _PAUSE_S)

    @property
    def is_idle(self) -> bool:
        """True if no command is unfinished or awaits its reply."""
        return not self.is_draining and not self._n_due and not self._commands.partial and self.is_quiet

    def check_draining(self, pending: bytes) -> bool:
        """Return whether replies to an earlier host may still arrive; `pending` are its unsent bytes."""
        if self.is_draining and not pending and (self.is_quiet or self._last_read_s > self._deadline_s):
            self.is_draining = False
            self._n_due = 0
        return self.is_draining


class _LineCounter:
    """Counter of the lines of one direction, without empty ones."""

    def __init__(self) -> None:
        self.partial = b""  # first byte of an unfinished line

    def count(self, data: bytes) -> int:
        """Count the lines that end in `data`."""
        *lines, remainder = re.split(rb"[\r\n]", self.partial + data)
        self.partial = remainder[:1]
        return sum(map(bool, lines))


def _wait_for_bytes(device: Device, port: HostPort, has_room: bool, has_pending: bool, held_s: float) -> None:
    """Wait for bytes to forward and room for them, at most `held_s` while pending bytes are held [s]."""
    descriptors = list(port.descriptors(has_room))
    if device.descriptor is None:
        wait_readable(descriptors, _POLL_INTERVAL_S)
    else:
        writable = [device.descriptor] if has_pending and not held_s else []
        timeout_s = min(held_s or LONGEST_WAIT_S, LONGEST_WAIT_S)
        select.select([*descriptors, device.descriptor], writable, [], timeout_s)


def start_wall_clock() -> Callable[[], int]:
    """Return a clock of wall time that starts at 0 [ns]."""
    start_ns = time.monotonic_ns()
    return lambda: time.monotonic_ns() - start_ns
