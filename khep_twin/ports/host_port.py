"""Connection of one robot of a served twin to its host: a pseudo-terminal, or a network connection."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from khep_twin.board.uart import LineSettings


class Received(NamedTuple):
    """Bytes from the hosts of a cable since the last call, and news about the hosts.

    Attributes:
        data: Bytes sent by hosts that are here.
        left: All hosts that were here have left, even if another came since; what they left is cleared.
        last: Bytes sent by hosts that have left.
        notices: Lines for the user who runs the server.
    """

    data: bytes = b""
    left: bool = False
    last: bytes = b""
    notices: Sequence[str] = ()


NOTHING = Received()
"""No bytes and no news."""


class HostPort(Protocol):
    """The far end of one robot's line."""

    @property
    def path(self) -> str:
        """Path or URL that a host opens."""
        ...

    @property
    def dropped(self) -> int:
        """Number of bytes that no host took in time."""
        ...

    @property
    def occupied(self) -> bool:
        """True if a host is there, as far as that can be known."""
        ...

    def descriptors(self, room: bool) -> Sequence[int]:
        """Return the descriptors that become readable when a host comes, goes or, if `room`, writes."""
        ...

    def settings(self) -> LineSettings | None:
        """Return the line settings of the host; None where it has set none, or where they cannot be seen."""
        ...

    def receive(self, limit: int, answered: bool = False) -> Received:
        """Take what hosts have sent, at most `limit` bytes unless they have left, and news about them.

        Args:
            limit: Most bytes that the robot's line takes now.
            answered: All that was taken so far is carried out and answered: a host that has finished sending
                and waits for its replies is let go.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send to the host."""
        ...

    def close(self) -> None:
        """Close the host's endpoint."""
        ...
