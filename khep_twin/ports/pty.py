"""A pseudo-terminal as the far end of a serial cable.

The terminal is raw before its name is printed: a fresh one would echo the robot's replies back to it as
commands. One descriptor of the host's side stays open here, so that the terminal outlives its hosts.
Settings, a lock and unread replies of a host are removed when the last one closes it, which `terminal_hosts`
detects.
"""

import errno
import fcntl
import math
import os
import select
import struct
import sys
import termios
import time
import tty
from collections.abc import Sequence
from contextlib import suppress
from typing import Self

if sys.platform == "win32":
    raise ImportError("a pseudo-terminal needs a system with terminals")

from khep_twin.board.uart import LineSettings
from khep_twin.errors import PortError
from khep_twin.files.paths import StrPath
from khep_twin.ports.event_sources import open_events
from khep_twin.ports.host_port import NOTHING, Received
from khep_twin.ports.host_writes import Change, Reading, divide_at_leaving
from khep_twin.ports.link import Link
from khep_twin.ports.terminal_hosts import TerminalHosts

_SPEEDS: dict[int, int] = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}
"""Bits per second of each of the system's own constants for them."""

_BOTHER, _TCGETS2 = 0o10000, 0x802C542A
"""Constant of any other speed, and request for the speed itself: Linux's, which Python does not name."""

_INPUT, _OUTPUT, _CONTROL, _LOCAL, _IN_SPEED, _OUT_SPEED = range(6)

_MOST_KEPT = 65536
"""Most bytes that are read of a host that has left; the kernel keeps some 20 kB at most."""

_CROWDED_S = 0.1
"""Time that several hosts must be there before it is reported, as tools such as stty come and go [s]."""

_TRANSIT_S = 0.02
"""Time after which a reply is at the host's side, where it can be seen until it is read (assumed) [s]."""

_RESTORE_S = 0.01
"""Time after which the settings of a host that has left are restored; the next one may set its own [s]."""

_IN_A_MOMENT = "a host came in the moment another left: it may have got replies meant for that one"


class PtyPort:
    """A `HostPort` that is a pseudo-terminal, under its own name and, if wanted, a link.

    Args:
        link: Path of a symbolic link to the terminal; our own leftovers are replaced, anything else is left
            alone.
        baud: Speed that the terminal has before a host sets its own [baud].

    Attributes:
        name: Name of the terminal, such as /dev/pts/7.
        descriptor: Descriptor of this side, for `select`.
        path: Path that a host opens: the link, or the terminal's own name.
        dropped: Number of bytes that no host took in time.
        occupied: True if a host has it open.

    Raises:
        PortError: There is no terminal, or the link cannot be made.
    """

    def __init__(self, link: StrPath | None = None, baud: int = 9600) -> None:
        try:
            self.descriptor, host_side = os.openpty()
        except OSError as error:
            raise PortError(
                f"no pseudo-terminal can be had: {error.strerror}; expected a free one, or --tcp HOST:PORT"
            ) from error
        self._raw = self._make_raw(host_side, baud)
        os.set_blocking(self.descriptor, False)
        self.name = self.path = os.ttyname(host_side)
        self.dropped = 0
        self._hosts = TerminalHosts(self.descriptor, host_side, open_events(self.name))
        self._readable = select.poll()
        self._readable.register(self.descriptor, select.POLLIN)
        self._descriptors = [self.descriptor, *self._hosts.descriptors]
        self._crowded_since: float | None = None
        self._left_s: float | None = None  # when the last host left, until its settings are restored
        self._given_s: float | None = None  # when bytes were written that may be unread
        self._reading = Reading.EVEN
        self._seen: tuple[object, object] | None = None
        self._settings: LineSettings | None = None
        self._link = None
        if link is not None:
            try:
                self._link = Link(link, self.name)
            except BaseException:
                self.close()
                raise
            self.path = str(self._link.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def occupied(self) -> bool:
        """True if a host has it open."""
        return self._hosts.hosts > 0

    def set_baud(self, baud: int) -> None:
        """Take the speed of the robot's line, which a host has that sets none [baud]."""
        if self._raw[_OUT_SPEED] != (speed := _constant(baud)):
            self._raw[_IN_SPEED] = self._raw[_OUT_SPEED] = speed
            # Also where no host is there to leave.
            self._left_s = time.monotonic() if self._left_s is None else self._left_s

    def descriptors(self, room: bool) -> Sequence[int]:
        """Return the descriptors that become readable when a host comes, goes or, if `room`, writes."""
        return self._descriptors[0 if room else 1 :]

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; a pseudo-terminal does not show parity and data bits."""
        flags = termios.tcgetattr(self.descriptor)
        speed = int(flags[_OUT_SPEED])
        baud = _SPEEDS.get(speed, speed)
        if speed == _BOTHER:
            with suppress(OSError):
                baud = struct.unpack_from("I", fcntl.ioctl(self.descriptor, _TCGETS2, bytes(44)), 40)[0]
        seen = (baud, flags[_CONTROL])
        if seen != self._seen:
            stop_bits = 2 if flags[_CONTROL] & termios.CSTOPB else 1
            self._seen, self._settings = seen, LineSettings(baud, stop_bits)
        return self._settings

    def receive(self, limit: int, answered: bool = False) -> Received:
        """Take what hosts have sent, at most `limit` bytes unless they have left, and news about them."""
        if self._left_s is not None:
            self._restore(self._left_s)
        # Bytes before events: the opening by their sender is then known.
        data, had_given = self._read(limit), self._given_s is not None
        self._forget_read_replies()
        is_full = self._is_full(data, limit)
        change = self._hosts.poll(bool(data))
        if change.left:
            return self._receive_at_leaving(data, 0 < len(data) < limit, change, had_given)
        # The writes that were just reported are counted with this call, so their bytes come with it, too.
        if change.writes_before and not is_full and self._readable.poll(0):
            data += self._read(limit - len(data))
            is_full = self._is_full(data, limit)
        self._reading = self._reading.after(bool(data), change.writes_before, is_full)
        notices = self._crowd()
        return Received(data, notices=notices) if data or notices else NOTHING

    def _receive_at_leaving(self, first: bytes, is_whole: bool, change: Change, had_given: bool) -> Received:
        """Take the rest of what hosts that have left have sent, and what others have sent since.

        Of what was read first, `is_whole` tells that these are some bytes and no limit has cut them off;
        `had_given` that bytes were written here that may have been unread.
        """
        self._crowded_since = None
        reading, self._reading = self._reading, Reading.EVEN
        rest = self._read_all()
        last, data = divide_at_leaving(reading, first, is_whole, rest, change, self._hosts.poll(False))
        if not self.occupied:
            self._clear()
            # One that came since that poll may have read them before they were flushed.
            crossed = had_given and not self._hosts.is_quiet()
            return Received(left=True, last=first + rest, notices=[_IN_A_MOMENT] if crossed else ())
        # The next host is already connected, and may have received unread replies.
        unread = self._drop_replies()
        # Writes that were read early may have been reported with later ones, in one run.
        crossed = unread or had_given or (data and (last or reading.is_ahead))
        return Received(data, left=True, last=last, notices=[_IN_A_MOMENT] if crossed else [])

    def write(self, data: bytes) -> None:
        """Send to the host; drop and count what a host that never reads leaves no room for."""
        try:
            sent = os.write(self.descriptor, data)
        except BlockingIOError:
            sent = 0
        self.dropped += len(data) - sent
        if sent:
            self._given_s = time.monotonic()

    def close(self) -> None:
        """Close the terminal, and remove the link if it is still ours."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self._hosts.close()
        os.close(self.descriptor)

    def _read(self, limit: int) -> bytes:
        try:
            return os.read(self.descriptor, limit) if limit else b""
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno != errno.EIO:  # hung up, with nothing left to read
                raise
            return b""

    def _is_full(self, data: bytes, limit: int) -> bool:
        """Return whether more is there to read than there was room for."""
        return len(data) == limit and bool(self._readable.poll(0))

    def _read_all(self) -> bytes:
        """Read what hosts that have left can have written; one that keeps writing does not block this."""
        data = b""
        # A read returns what is ready; bytes in transit come with the next one.
        while more := self._read(_MOST_KEPT - len(data)):
            data += more
        return data

    def _clear(self) -> None:
        """Unlock the terminal and flush its replies; `_restore` puts the settings back later."""
        host_side = self._hosts.host_side
        if self._hosts.is_quiet():
            fcntl.ioctl(host_side, termios.TIOCNXCL)
        termios.tcflow(host_side, termios.TCOON)
        self._drop_replies()
        self._left_s = time.monotonic()

    def _restore(self, left_s: float) -> None:
        """Restore the settings after a while without a host; one that connects at once sets its own."""
        if self.occupied or time.monotonic() - left_s >= _RESTORE_S:
            if not self.occupied and self._hosts.is_quiet():
                termios.tcsetattr(self._hosts.host_side, termios.TCSANOW, self._raw)
            self._left_s = None

    def _drop_replies(self) -> int:
        """Flush replies that no host has read; return the number of bytes."""
        unread = self._unread()
        # They may be in transit to the host side's buffer, or in it.
        termios.tcflush(self.descriptor, termios.TCOFLUSH)
        termios.tcflush(self._hosts.host_side, termios.TCIFLUSH)
        self._given_s = None
        return unread

    def _forget_read_replies(self) -> None:
        """Note that the host has read all that was written, once it can be seen."""
        if (
            self._given_s is not None
            and time.monotonic() - self._given_s >= _TRANSIT_S
            and not self._unread()
        ):
            self._given_s = None

    def _unread(self) -> int:
        """Return the number of bytes that have reached the host's side, and that no host has read."""
        return struct.unpack("i", fcntl.ioctl(self._hosts.host_side, termios.FIONREAD, bytes(4)))[0]

    def _crowd(self) -> Sequence[str]:
        """Return a notice, once, if several hosts are here for a while."""
        if self._hosts.hosts < 2:
            self._crowded_since = None
            return ()
        now = time.monotonic()
        if self._crowded_since is None:
            self._crowded_since = now
        if now - self._crowded_since < _CROWDED_S:
            return ()
        self._crowded_since = math.inf
        if self._hosts.recount() < 2:
            return ()
        return (
            f"the port is open {self._hosts.hosts} times at once; each reader takes bytes from the others",
        )

    def _make_raw(self, host_side: int, baud: int) -> list[int | list[bytes | int]]:
        """Make it raw, at the robot's own speed: a host that sets none counts as matching."""
        tty.setraw(host_side)
        flags = termios.tcgetattr(host_side)
        flags[_CONTROL] |= termios.CSTOPB
        flags[_IN_SPEED] = flags[_OUT_SPEED] = _constant(baud)
        termios.tcsetattr(host_side, termios.TCSANOW, flags)
        return termios.tcgetattr(host_side)


def _constant(baud: int) -> int:
    """Return the system's constant for a speed [baud]."""
    return getattr(termios, f"B{baud}", termios.B9600)
