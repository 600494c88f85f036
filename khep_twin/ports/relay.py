"""A relay to a real robot: a cable with a recorder.

Host and robot communicate as if the relay were not there, at the speed that the host sets; the bytes of
both are passed on as they come, and recorded with their times.
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
from khep_twin.ports.serve import LONGEST_WAIT, Flush
from khep_twin.units import BITS_PER_BYTE

_CHUNK = 1024
"""Most bytes passed on at once."""

_POLL = 0.001
"""Interval at which a port that cannot wake the loop is polled [s]."""

_PAUSE_S = 0.02
"""Silence after the last reply that was due, before the next host may speak [s]."""

_SILENCE_S = 0.5
"""Silence after which a robot that owes replies is taken not to send them (assumed) [s]."""

_BEGIN_S = 2.0
"""Longest time for which what a robot says is taken for replies to an earlier relay (assumed) [s]."""

_LONGEST = 2048
"""Bytes of the longest reply, that of `list` [bytes]."""

_UNDERWAY_S = 1.0
"""Longest transit of sent bytes through an adapter's buffer (assumed) [s]."""

_SPOIL = b"?\n"
"""End of a line that a host has left unfinished: the robot answers with an error and obeys no half of it."""

_KEPT = _CHUNK - len(_SPOIL)
"""Bytes of a host that has left for which the next one waits; a second's worth at 9600 baud."""


class LineListener(Protocol):
    """A listener on a line, such as a log's `LineRecorder`; none may delay the line."""

    def on_bytes(self, to_robot: bool, data: bytes) -> None:
        """Take bytes that cross the line now."""
        ...

    def on_event(self, text: str) -> None:
        """Take an event of the line."""
        ...

    def flush(self) -> None:
        """Pass on everything so far; called twice a second."""
        ...


class Device:
    """A robot's own port, as pyserial opens it.

    Args:
        url: Device such as /dev/ttyUSB0, or URL of pyserial's.
        baud: Speed of the robot's line [baud].

    Attributes:
        url: URL that was opened.
        descriptor: Descriptor for `select`; None where the port has none.

    Raises:
        PortError: The port cannot be opened, or is no robot's; here and in each method: it has gone.
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
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else error
            raise PortError(address_fault(url) or f"{url}: cannot open this port: {reason}") from None
        try:
            self.descriptor: int | None = self._port.fileno()
            self._port.write_timeout = 0
        except OSError:
            # Its writes return when all is sent.
            self.descriptor = None

    def follow(self, host: LineSettings) -> str:
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
        """Speed of the robot's line [baud]."""
        return self._port.baudrate

    def read(self) -> bytes:
        """Return the bytes that have come from the robot."""
        with self._checked():
            return self._port.read(_CHUNK if self.descriptor is not None else self._port.in_waiting)

    def write(self, data: bytes) -> int:
        """Send to the robot; return how many bytes the port took."""
        with self._checked():
            # pyserial tries again without end while there is no room.
            if self.descriptor is not None and not select.select([], [self.descriptor], [], 0)[1]:
                return 0
            return self._port.write(data) or 0

    @property
    def unsent(self) -> int:
        """Return the number of bytes that the port has taken and not sent yet, where it reports that."""
        with self._checked():
            return self._port.out_waiting if isinstance(self._port, serial.Serial) else 0

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    @contextmanager
    def _checked(self) -> Generator[None]:
        """Turn the failure of the port into a `PortError`."""
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
        port: Cable to the host.
        listeners: Listeners on the bytes of both, such as a log.
        polls: Polls of the relay's own; None for none.
        stop: Callback that is called once per cycle; True ends it.
        notify: Callback that takes notices for the user.

    Raises:
        PortError: The robot's port failed.
    """

    def note(text: str) -> None:
        notify(f"{port.path}: {text}")
        for each in listeners:
            each.on_event(text)

    def on_bytes(to_robot: bool, data: bytes) -> None:
        for each in listeners if data else ():
            each.on_bytes(to_robot, data)

    flushes = [Flush(each) for each in listeners]
    dialogue, limit = _Dialogue(device), NoticeLimit()
    waiting, next_host = b"", b""
    held_s = 0.0
    while not stop():
        # The next host is heard while one that has left still speaks, to know that it waits.
        room = not next_host and (not waiting or dialogue.ended)
        _wait(device, port, room, bool(waiting), held_s)
        # Replies before hosts: silence counts up to a read that found nothing, however late this turn is.
        reply = dialogue.read()
        on_bytes(False, reply)
        passed = polls.passed(reply) if polls is not None and reply else reply
        received = port.receive(_CHUNK if room else 0, room and not waiting and dialogue.answered)
        for notice in received.notices:
            note(notice)
        if received.left:
            passed = b""
            # What was held back is of a host that has left, too.
            on_bytes(True, received.last)
            unsent = waiting + next_host + received.last
            waiting, next_host = dialogue.end(unsent), b""
            on_bytes(True, waiting[len(unsent) :])
        if received.data:
            on_bytes(True, received.data)
            next_host = received.data
        if next_host and dialogue.ended and len(waiting) > _CHUNK:
            note(f"{len(waiting) - _KEPT} bytes of a host that has left were dropped: the next one waits")
            waiting = dialogue.end(waiting[:_KEPT])
        if not dialogue.settling(waiting) and next_host:
            settings = port.settings()
            if settings is not None and (notice := device.follow(settings)):
                for text in limit.admit([notice]):
                    note(text)
            waiting, next_host = waiting + next_host, b""
        if polls is not None:
            held_s = polls.hold_s(waiting)
            if not next_host and not waiting and dialogue.idle:
                on_bytes(True, waiting := polls.due(device.baud))
        if waiting and not held_s:
            waiting = dialogue.send(waiting)
        if passed and port.occupied and not dialogue.ended:
            port.write(passed)
        for flush in flushes:
            flush()


class _Dialogue:
    """Lines sent to the robot and replies due, so that no host gets a reply meant for an earlier one."""

    def __init__(self, device: Device) -> None:
        self.ended = True  # a host has left, maybe one of an earlier relay, and replies to it may still come
        self._device = device
        self._due = 0
        self._asked, self._replied = _Lines(), _Lines()
        self._read_s = self._quiet_since = time.monotonic()
        self._end_s = self._quiet_since + _BEGIN_S  # a robot may also speak without being asked

    def send(self, data: bytes) -> bytes:
        """Send to the robot; return what is still to be sent."""
        count = self._device.write(data[:_CHUNK])
        self._due += self._asked.count(data[:count])
        busy_s = count * BITS_PER_BYTE / self._device.baud
        now = time.monotonic()
        self._quiet_since = min(max(self._quiet_since, now) + busy_s, now + _UNDERWAY_S)
        self._expect(self._quiet_since)
        return data[count:]

    def read(self) -> bytes:
        """Return the bytes that have come from the robot, with their replies counted."""
        self._read_s = time.monotonic()
        if reply := self._device.read():
            count = self._replied.count(reply)
            if self._due and count:
                self._due = max(self._due - count, 0)
                self._expect(self._read_s)
            self._quiet_since = max(self._quiet_since, time.monotonic())
        elif self._due and self.answered:
            self._due = 0  # they were lost
        return reply

    def end(self, waiting: bytes) -> bytes:
        """Note that the host has left; return what must be sent of it, after the bytes that wait already."""
        begun = (self._asked.begun + waiting)[-1:]
        if begun and begun not in b"\r\n":
            waiting += _SPOIL
        # Of a reply of several lines, only the first one was due.
        if waiting or self._due or not self.answered:
            self.ended = True
            self._expect(self._read_s)
        return waiting

    def _expect(self, since_s: float) -> None:
        """Take what the robot says for replies for as long as the longest one takes."""
        since_s += _LONGEST * BITS_PER_BYTE / self._device.baud
        self._end_s = max(self._end_s, since_s + _BEGIN_S)

    @property
    def answered(self) -> bool:
        """Return whether all is answered, or will not be: the robot had long been silent at the last read."""
        if self._device.unsent:
            self._quiet_since = max(self._quiet_since, time.monotonic())
        more = self._due or self._replied.begun
        return self._read_s - self._quiet_since > (_SILENCE_S if more else _PAUSE_S)

    @property
    def idle(self) -> bool:
        """Return whether no command is begun or waits for its reply."""
        return not self.ended and not self._due and not self._asked.begun and self.answered

    def settling(self, waiting: bytes) -> bool:
        """Return whether replies to a host that has left may still come; `waiting` was not sent yet."""
        if self.ended and not waiting and (self.answered or self._read_s > self._end_s):
            self.ended, self._due = False, 0
        return self.ended


class _Lines:
    """Lines of one direction, without empty ones."""

    def __init__(self) -> None:
        self.begun = b""  # first byte of a line that has not ended

    def count(self, data: bytes) -> int:
        """Return the number of lines that end in `data`."""
        *lines, begun = re.split(rb"[\r\n]", self.begun + data)
        self.begun = begun[:1]
        return sum(map(bool, lines))


def _wait(device: Device, port: HostPort, room: bool, waiting: bool, held_s: float) -> None:
    """Wait until there is something to pass on, and room for it; what waits is held for a while."""
    descriptors = list(port.descriptors(room))
    if device.descriptor is None:
        select.select(descriptors, [], [], _POLL)
    else:
        full = [device.descriptor] if waiting and not held_s else []
        select.select([*descriptors, device.descriptor], full, [], min(held_s or LONGEST_WAIT, LONGEST_WAIT))


def since_now() -> Callable[[], int]:
    """Return a clock of wall time that starts at 0 [ns]."""
    start_ns = time.monotonic_ns()
    return lambda: time.monotonic_ns() - start_ns
