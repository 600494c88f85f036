"""A pseudo-terminal as the far end of a serial cable.

The terminal is raw before anybody can know its name: a fresh one would echo the robot's replies back to it as
commands. One descriptor of the host's side stays open here, so that the terminal outlives its hosts; what a
host leaves behind (settings, a lock, unread replies) is cleared away when the last one closes it, as a cable
would. inotify tells of opening and closing, even when the host was killed; where there is no inotify, nothing
is cleared.
"""

import ctypes
import fcntl
import os
import struct
import termios
import tty
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

from khep_twin.errors import PortError

_IN_OPEN, _IN_CLOSE_WRITE, _IN_CLOSE_NOWRITE = 0x20, 0x08, 0x10
_EVENT = struct.Struct("iIII")


class PtyPort:
    """A pseudo-terminal, under its own name and, if wanted, a link.

    Args:
        link: path of a symbolic link to the terminal; one that leads nowhere is replaced, anything else is
            left alone.

    Attributes:
        name: the terminal's own name, such as /dev/pts/7.
        descriptor: this side of it, for `select`.
        dropped: bytes that no host took in time.
        hosts: how many hosts have it open, None where that cannot be known.
        descriptors: what becomes readable when a host writes, opens or closes.

    Raises:
        PortError: the link cannot be made.
    """

    def __init__(self, link: Path | None = None) -> None:
        self.descriptor, self._host_side = os.openpty()
        tty.setraw(self._host_side)
        os.set_blocking(self.descriptor, False)
        self.name = os.ttyname(self._host_side)
        self.dropped = 0
        self._watch = _watch(self.name)
        self.hosts = None if self._watch is None else 0
        self.descriptors = [self.descriptor, *([] if self._watch is None else [self._watch])]
        self._link = None
        if link is not None:
            try:
                self._make_link(link)
            except PortError:
                self.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def path(self) -> str:
        """What a host opens: the link, or the terminal's own name."""
        return str(self._link or self.name)

    def read(self, limit: int) -> bytes:
        """What the host has sent, at most `limit` bytes; empty when nothing is waiting."""
        try:
            return os.read(self.descriptor, limit)
        except BlockingIOError:
            return b""

    def last_host_left(self) -> bool:
        """Takes note of hosts that came and went; whether the last one has gone since the last look."""
        if self._watch is None or self.hosts is None:
            return False
        left = False
        with suppress(BlockingIOError):
            events = os.read(self._watch, 65536)
            for place in range(0, len(events), _EVENT.size):
                _, mask, _, _ = _EVENT.unpack_from(events, place)
                self.hosts += 1 if mask & _IN_OPEN else -1
                left = left or self.hosts == 0
        return left and self.hosts == 0

    def clear(self) -> None:
        """Puts the terminal back to how the first host found it, with nothing on the way."""
        fcntl.ioctl(self._host_side, termios.TIOCNXCL)
        tty.setraw(self._host_side)
        termios.tcflow(self._host_side, termios.TCOON)
        # Either end has a buffer of its own.
        for descriptor in (self._host_side, self.descriptor):
            termios.tcflush(descriptor, termios.TCIOFLUSH)

    def write(self, data: bytes) -> None:
        """Sends to the host; what a host that never reads leaves no room for is dropped and counted."""
        try:
            sent = os.write(self.descriptor, data)
        except BlockingIOError:
            sent = 0
        self.dropped += len(data) - sent

    def close(self) -> None:
        """Takes the terminal away, and the link if it still is ours."""
        if self._link is not None and self._points_here(self._link):
            self._link.unlink()
        self._link = None
        for descriptor in (*self.descriptors, self._host_side):
            os.close(descriptor)

    def _make_link(self, link: Path) -> None:
        if os.path.lexists(link) and not link.is_symlink():
            raise PortError(f"{link}: there is something that is no link; name another path for --link")
        if link.is_symlink() and os.readlink(link) != self.name and link.exists():
            raise PortError(
                f"{link}: this link leads to {os.readlink(link)}, which is there; name another path for "
                "--link, or remove the link if it is left over"
            )
        beside = link.with_name(f".{link.name}.{os.getpid()}")
        try:
            beside.symlink_to(self.name)
            os.replace(beside, link)
        except OSError as error:
            raise PortError(f"{link}: cannot make this link: {error.strerror}") from error
        self._link = link

    def _points_here(self, link: Path) -> bool:
        return link.is_symlink() and os.readlink(link) == self.name


def _watch(path: str) -> int | None:
    """A descriptor that tells of opening and closing a file, None where the system has no such thing."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "inotify_init1"):
        return None
    watch = libc.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
    if watch < 0:
        return None
    if libc.inotify_add_watch(watch, path.encode(), _IN_OPEN | _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE) < 0:
        os.close(watch)
        return None
    return int(watch)
