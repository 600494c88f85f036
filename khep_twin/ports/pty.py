"""A pseudo-terminal as the far end of a serial cable.

The terminal is raw before anybody can know its name: a fresh one would echo the robot's replies back to it as
commands. One descriptor of the host's side stays open here, so that a host that closes the port and comes
back finds it as it was.
"""

import os
import tty
from pathlib import Path
from types import TracebackType
from typing import Self

from khep_twin.errors import PortError


class PtyPort:
    """A pseudo-terminal, under its own name and, if wanted, a link.

    Args:
        link: path of a symbolic link to the terminal; one that is there already is replaced, anything else
            is left alone.

    Attributes:
        name: the terminal's own name, such as /dev/pts/7.
        descriptor: this side of it, for `select`.
        dropped: bytes that no host took in time.

    Raises:
        PortError: the link cannot be made.
    """

    def __init__(self, link: Path | None = None) -> None:
        self.descriptor, self._host_side = os.openpty()
        tty.setraw(self._host_side)
        os.set_blocking(self.descriptor, False)
        self.name = os.ttyname(self._host_side)
        self.dropped = 0
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
        for descriptor in (self.descriptor, self._host_side):
            os.close(descriptor)

    def _make_link(self, link: Path) -> None:
        if os.path.lexists(link) and not link.is_symlink():
            raise PortError(f"{link}: there is something that is no link; name another path for --link")
        beside = link.with_name(f".{link.name}.{os.getpid()}")
        try:
            beside.symlink_to(self.name)
            os.replace(beside, link)
        except OSError as error:
            raise PortError(f"{link}: cannot make this link: {error.strerror}") from error
        self._link = link

    def _points_here(self, link: Path) -> bool:
        return link.is_symlink() and os.readlink(link) == self.name
