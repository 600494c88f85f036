"""What joins one robot of a served twin and its host: a pseudo-terminal, or a connection over a network."""

from collections.abc import Sequence
from typing import Protocol

from khep_twin.uart import LineSettings

IN_A_MOMENT = "a host came in the moment another left: it may find what that one left behind"
"""What is told when a cable cannot be cleared because the next host is there already."""


class Cable(Protocol):
    """The far end of one robot's line."""

    @property
    def path(self) -> str:
        """What a host opens."""
        ...

    @property
    def dropped(self) -> int:
        """Bytes that no host took in time."""
        ...

    @property
    def occupied(self) -> bool:
        """Whether a host is there, as far as that can be known."""
        ...

    def descriptors(self, room: bool) -> Sequence[int]:
        """What becomes readable when a host comes, goes or, if there is room for it, writes."""
        ...

    def settings(self) -> LineSettings | None:
        """How the host has set its end; None where it has not, or where that cannot be seen."""
        ...

    def look(self) -> tuple[bool, Sequence[str]]:
        """Whether the last host has left since the last look, and what else there is to tell."""
        ...

    def read(self, limit: int) -> bytes:
        """What the host has sent, at most `limit` bytes."""
        ...

    def write(self, data: bytes) -> None:
        """Sends to the host."""
        ...

    def clear(self) -> bool:
        """Takes away what a host has left behind, unless another is there already; whether it did."""
        ...

    def close(self) -> None:
        """Takes the far end away."""
        ...
