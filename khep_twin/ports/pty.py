"""A pseudo-terminal as a host port: a pair of devices by which a program is a serial port for others.

The terminal is raw before its name is printed: in its initial mode it would echo the robot's replies back as
commands. One descriptor of the host's side stays open here, so that the terminal exists without hosts.

    vacant --opened--> occupied --a second host for 0.1 s--> shared, which is reported once
       ^                  |                                     |
       +------------------+-----------last one closed-----------+

The change to vacant, which `terminal_hosts` detects, removes a lock and unread replies, after 10 ms settings.
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
from khep_twin.ports.host_writes import Change, ReadState, split_at_departure
from khep_twin.ports.link import Link
from khep_twin.ports.terminal_hosts import TerminalHosts

_BAUD_RATES: dict[int, int] = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}
"""Baud rate by the system's constant for it."""

_BOTHER, _TCGETS2 = 0o10000, 0x802C542A
"""Linux's constant for other baud rates, and request for the settings: 44 bytes, the rate from byte 40 on."""

_INPUT, _OUTPUT, _CONTROL, _LOCAL, _IN_SPEED, _OUT_SPEED = range(6)

_READ_LIMIT = 65536
"""Most bytes that are read from a host that has left; the kernel buffers at most about 20 kB."""

_SHARED_S = 0.1
"""Time after which several hosts are reported; tools such as stty open the port only briefly [s]."""

_TRANSIT_S = 0.02
"""Time after which a reply is in the host's buffer, where it is counted until it is read (assumed) [s]."""

_RESTORE_S = 0.01
"""Time after which the settings are restored without a host; the next one may set others first [s]."""

_MIXED_NOTICE = "a host came in the moment another left: it may have got replies meant for that one"


class PtyPort:
    """A `HostPort` that is a pseudo-terminal, with an optional link to it.

    Args:
        link: Path of a symbolic link to the terminal; only stale links of khep_twin are replaced.
        baud: Baud rate of the terminal before a host sets another.

    Attributes:
        name: Name of the terminal, for example /dev/pts/7.
        descriptor: Descriptor of this side, for `select`.
        path: Path that a host opens: the link, or the terminal's name.
        dropped: Number of reply bytes that were dropped because no host read them in time.
        occupied: True if a host has it open.

    Raises:
        PortError: No terminal is free, or the link cannot be made.
    """

    def __init__(self, link: StrPath | None = None, baud: int = 9600) -> None:
        try:
            self.descriptor, host_side = os.openpty()
        except OSError as error:
            raise PortError(
                f"no pseudo-terminal is available: {error.strerror}; expected a free one, or --tcp HOST:PORT"
            ) from error
        self._raw_settings = self._make_raw(host_side, baud)
        os.set_blocking(self.descriptor, False)
        self.name = self.path = os.ttyname(host_side)
        self.dropped = 0
        self._hosts = TerminalHosts(self.descriptor, host_side, open_events(self.name))
        self._readable = select.poll()
        self._readable.register(self.descriptor, select.POLLIN)
        self._descriptors = [self.descriptor, *self._hosts.descriptors]
        self._shared_since_s: float | None = None
        self._vacant_since_s: float | None = None  # from the last host's closing to the restoration
        self._unread_write_s: float | None = None  # last write that may be unread
        self._read_state = ReadState.MATCHED
        self._line_state: tuple[object, object] | None = None
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
        return self._hosts.n_hosts > 0

    def set_baud(self, baud: int) -> None:
        """Set the baud rate of the robot's line, which applies to a host that sets none."""
        if self._raw_settings[_OUT_SPEED] != (speed := _speed_constant(baud)):
            self._raw_settings[_IN_SPEED] = self._raw_settings[_OUT_SPEED] = speed
            # Restores the settings even without a host that leaves.
            self._vacant_since_s = time.monotonic() if self._vacant_since_s is None else self._vacant_since_s

    def descriptors(self, has_room: bool) -> Sequence[int]:
        """Return the descriptors that are readable when a host connects, leaves or, if `has_room`, writes."""
        return self._descriptors[0 if has_room else 1 :]

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; a pseudo-terminal does not report parity and data bits."""
        attributes = termios.tcgetattr(self.descriptor)
        speed = int(attributes[_OUT_SPEED])
        baud = _BAUD_RATES.get(speed, speed)
        if speed == _BOTHER:
            with suppress(OSError):
                baud = struct.unpack_from("I", fcntl.ioctl(self.descriptor, _TCGETS2, bytes(44)), 40)[0]
        line_state = (baud, attributes[_CONTROL])
        if line_state != self._line_state:
            stop_bits = 2 if attributes[_CONTROL] & termios.CSTOPB else 1
            self._line_state = line_state
            self._settings = LineSettings(baud, stop_bits)
        return self._settings

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        """Return the hosts' bytes, at most `limit` from connected ones, and changes among the hosts."""
        if self._vacant_since_s is not None:
            self._restore_settings(self._vacant_since_s)
        # Bytes are read before events, so that the opening by their sender is known.
        data, had_unread = self._read(limit), self._unread_write_s is not None
        self._note_read_replies()
        is_full = self._is_full(data, limit)
        change = self._hosts.poll(bool(data))
        if change.hosts_left:
            return self._receive_last(data, 0 < len(data) < limit, change, had_unread)
        # The writes that were just reported count for this call, so their bytes are also read now.
        if change.old_writes and not is_full and self._readable.poll(0):
            data += self._read(limit - len(data))
            is_full = self._is_full(data, limit)
        self._read_state = self._read_state.next_state(bool(data), change.old_writes, is_full)
        notices = self._sharing_notices()
        return Received(data, notices=notices) if data or notices else NOTHING

    def _receive_last(self, first: bytes, is_complete: bool, change: Change, had_unread: bool) -> Received:
        """Return the last bytes of hosts that have left, and the bytes of the next ones.

        `first` are the bytes read so far; `is_complete` is True if they are not empty and not cut off by
        the limit, and `had_unread` if replies may have been unread.
        """
        self._shared_since_s = None
        state, self._read_state = self._read_state, ReadState.MATCHED
        rest = self._read_all()
        last_data, data = split_at_departure(state, first, is_complete, rest, change, self._hosts.poll(False))
        if not self.occupied:
            self._release_terminal()
            # A host that has connected since that poll may have read them before they were flushed.
            is_mixed = had_unread and not self._hosts.is_quiet()
            return Received(b"", True, first + rest, [_MIXED_NOTICE] if is_mixed else ())
        # The next host is already connected, and may have received unread replies.
        n_unread = self._drop_replies()
        # Writes that were read early may have been reported with later ones, in one run.
        is_mixed = n_unread or had_unread or (data and (last_data or state.has_unreported))
        return Received(data, True, last_data, [_MIXED_NOTICE] if is_mixed else [])

    def write(self, data: bytes, is_end: bool = False) -> None:
        """Send to the host; bytes without room are dropped and counted."""
        try:
            n_sent = os.write(self.descriptor, data)
        except BlockingIOError:
            n_sent = 0
        self.dropped += len(data) - n_sent
        if n_sent:
            self._unread_write_s = time.monotonic()

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
            if error.errno != errno.EIO:  # hung up, without unread bytes
                raise
            return b""

    def _is_full(self, data: bytes, limit: int) -> bool:
        """Return whether more bytes are pending than there was room for."""
        return len(data) == limit and bool(self._readable.poll(0))

    def _read_all(self) -> bytes:
        """Read the bytes of hosts that have left, at most _READ_LIMIT even if another host keeps writing."""
        data = b""
        # A read returns the available bytes; the next one returns bytes in transit.
        while chunk := self._read(_READ_LIMIT - len(data)):
            data += chunk
        return data

    def _release_terminal(self) -> None:
        """Unlock the terminal and flush its replies; `_restore_settings` restores the settings later."""
        host_side = self._hosts.host_side
        if self._hosts.is_quiet():
            fcntl.ioctl(host_side, termios.TIOCNXCL)
        termios.tcflow(host_side, termios.TCOON)
        self._drop_replies()
        self._vacant_since_s = time.monotonic()

    def _restore_settings(self, vacant_s: float) -> None:
        """Restore the settings _RESTORE_S after the last host has left, unless another one has connected."""
        if self.occupied or time.monotonic() - vacant_s >= _RESTORE_S:
            if not self.occupied and self._hosts.is_quiet():
                termios.tcsetattr(self._hosts.host_side, termios.TCSANOW, self._raw_settings)
            self._vacant_since_s = None

    def _drop_replies(self) -> int:
        """Flush replies that no host has read; return the number of bytes."""
        n_unread = self._count_unread()
        # They may be in transit to the host side's buffer, or in it.
        termios.tcflush(self.descriptor, termios.TCOFLUSH)
        termios.tcflush(self._hosts.host_side, termios.TCIFLUSH)
        self._unread_write_s = None
        return n_unread

    def _note_read_replies(self) -> None:
        """Forget the last write once the kernel reports that the host has read all replies."""
        if (
            self._unread_write_s is not None
            and time.monotonic() - self._unread_write_s >= _TRANSIT_S
            and not self._count_unread()
        ):
            self._unread_write_s = None

    def _count_unread(self) -> int:
        """Return the number of unread bytes in the host side's buffer."""
        return struct.unpack("i", fcntl.ioctl(self._hosts.host_side, termios.FIONREAD, bytes(4)))[0]

    def _sharing_notices(self) -> Sequence[str]:
        """Return a notice, once, if several hosts are connected for _SHARED_S."""
        if self._hosts.n_hosts < 2:
            self._shared_since_s = None
            return ()
        now = time.monotonic()
        if self._shared_since_s is None:
            self._shared_since_s = now
        if now - self._shared_since_s < _SHARED_S:
            return ()
        self._shared_since_s = math.inf
        if self._hosts.recount() < 2:
            return ()
        return (
            f"the port is open {self._hosts.n_hosts} times at once; each reader takes bytes from the others",
        )

    def _make_raw(self, host_side: int, baud: int) -> list[int | list[bytes | int]]:
        """Make it raw, at the robot's baud rate: a host that sets none counts as matching."""
        tty.setraw(host_side)
        attributes = termios.tcgetattr(host_side)
        attributes[_CONTROL] |= termios.CSTOPB
        attributes[_IN_SPEED] = attributes[_OUT_SPEED] = _speed_constant(baud)
        termios.tcsetattr(host_side, termios.TCSANOW, attributes)
        return termios.tcgetattr(host_side)


def _speed_constant(baud: int) -> int:
    """Return the system's constant for a baud rate."""
    return getattr(termios, f"B{baud}", termios.B9600)
