"""A pseudo-terminal as the far end of a serial cable.

The terminal is raw before anybody can know its name: a fresh one would echo the robot's replies back to it as
commands. One descriptor of the host's side stays open here, so that the terminal outlives its hosts; what a
host leaves behind (settings, a lock, unread replies) is cleared away when the last one closes it, as a cable
would. inotify tells of opening and closing, even when the host was killed. Where there is no inotify, the
terminal is not kept open but asked whether it is hung up.
"""

import errno
import fcntl
import os
import termios
import tty
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

from khep_twin.errors import PortError
from khep_twin.ports.cable import IN_A_MOMENT
from khep_twin.ports.link import Link
from khep_twin.ports.wakeups import HangUps, Watch, watch
from khep_twin.uart import LineSettings

_SPEEDS: dict[int, int] = {
    getattr(termios, name): int(name[1:]) for name in dir(termios) if name[0] == "B" and name[1:].isdigit()
}
"""Bits per second of each of the system's own constants for them."""

_INPUT, _OUTPUT, _CONTROL, _LOCAL, _IN_SPEED, _OUT_SPEED = range(6)


class PtyPort:
    """A `Cable`: a pseudo-terminal, under its own name and, if wanted, a link.

    Args:
        link: path of a symbolic link to the terminal; our own leftovers are replaced, anything else is left
            alone.
        baud: speed that the terminal has before a host sets its own.

    Attributes:
        name: the terminal's own name, such as /dev/pts/7.
        descriptor: this side of it, for `select`.
        path: what a host opens: the link, or the terminal's own name.
        dropped: bytes that no host took in time.
        occupied: whether a host has it open.

    Raises:
        PortError: the link cannot be made.
    """

    def __init__(self, link: str | Path | None = None, baud: int = 9600) -> None:
        self.descriptor, kept = os.openpty()
        self._kept: int | None = kept
        self._baud = baud
        self._make_raw()
        os.set_blocking(self.descriptor, False)
        self.name = self.path = os.ttyname(kept)
        self.dropped = 0
        wakes = watch(self.name, own=1)
        self._watch: Watch = HangUps(self.descriptor) if wakes is None else wakes
        if wakes is None:
            os.close(kept)
            self._kept = None
        self._crowded = False
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def occupied(self) -> bool:
        """Whether a host has it open."""
        return self._watch.hosts > 0

    def descriptors(self, room: bool) -> Sequence[int]:
        """What becomes readable when a host comes, goes or, if there is room for it, writes."""
        wakes = self._watch.descriptor
        if wakes is not None:
            return [*([self.descriptor] if room else []), wakes]
        # A terminal that is hung up is readable all the time.
        return [self.descriptor] if room and self.occupied else []

    def settings(self) -> LineSettings | None:
        """How the host has set its end; parity and data bits cannot be seen on a pseudo-terminal."""
        flags = termios.tcgetattr(self.descriptor)
        stop_bits = 2 if flags[_CONTROL] & termios.CSTOPB else 1
        speed = int(flags[_OUT_SPEED])
        return LineSettings(_SPEEDS.get(speed, speed), stop_bits)

    def look(self) -> tuple[bool, Sequence[str]]:
        """Whether the last host has left since the last look, and whether there were two at once."""
        left, in_a_moment = self._watch.look()
        told, self._crowded = self._crowded, self._watch.hosts > 1
        notices: list[str] = []
        if in_a_moment:
            # Its settings and commands are the new host's already; only unread replies can be taken back.
            with self._host_side() as host_side:
                termios.tcflush(host_side, termios.TCIFLUSH)
            notices.append(IN_A_MOMENT)
        if self._crowded and not told:
            notices.append(
                f"{self._watch.hosts} hosts have the port open at once and take each other's bytes"
            )
        return left, notices

    def read(self, limit: int) -> bytes:
        """What the host has sent, at most `limit` bytes; empty when nothing is waiting."""
        try:
            return os.read(self.descriptor, limit) if limit else b""
        except BlockingIOError:
            return b""
        except OSError as error:
            if error.errno != errno.EIO:  # hung up, with nothing left to read
                raise
            return b""

    def write(self, data: bytes) -> None:
        """Sends to the host; what a host that never reads leaves no room for is dropped and counted."""
        try:
            sent = os.write(self.descriptor, data)
        except BlockingIOError:
            sent = 0
        self.dropped += len(data) - sent

    def clear(self) -> bool:
        """Puts the terminal back to how the first host found it, with nothing on the way.

        Returns:
            Whether it did; not if another host has come meanwhile, whose terminal it is by now.
        """
        if self._watch.pending():
            return False
        with self._host_side() as host_side:
            fcntl.ioctl(host_side, termios.TIOCNXCL)
            self._make_raw()
            termios.tcflow(host_side, termios.TCOON)
            # Either end has a buffer of its own.
            for descriptor in (host_side, self.descriptor):
                termios.tcflush(descriptor, termios.TCIOFLUSH)
        return True

    def close(self) -> None:
        """Takes the terminal away, and the link if it still is ours."""
        if self._link is not None:
            self._link.close()
            self._link = None
        self._watch.close()
        for descriptor in (self.descriptor, self._kept):
            if descriptor is not None:
                os.close(descriptor)

    def _make_raw(self) -> None:
        """Raw, at the robot's own speed: a host that sets none is taken to have the right one."""
        with self._host_side() as host_side:
            tty.setraw(host_side)
            flags = termios.tcgetattr(host_side)
            flags[_CONTROL] |= termios.CSTOPB
            speed = getattr(termios, f"B{self._baud}", termios.B9600)
            flags[_IN_SPEED] = flags[_OUT_SPEED] = speed
            termios.tcsetattr(host_side, termios.TCSANOW, flags)

    @contextmanager
    def _host_side(self) -> Generator[int, None, None]:
        """The host's side: the descriptor that is kept, or one for the moment."""
        if self._kept is not None:
            yield self._kept
            return
        try:
            descriptor = os.open(self.name, os.O_RDWR | os.O_NOCTTY)
        except OSError as error:
            # An exclusive lock outlives its host here, and nobody can take it away.
            raise PortError(f"{self.path}: a host has left it locked; right is to serve anew") from error
        try:
            yield descriptor
        finally:
            os.close(descriptor)
