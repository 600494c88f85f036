"""Live view of `khep-twin serve` and `run` in Foxglove."""

from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.options import complain

if TYPE_CHECKING:
    from khep_twin.log.foxglove_live import FoxgloveServer

ADDRESS = "127.0.0.1:8765"
"""Default address, which Foxglove proposes, too."""


@dataclass(frozen=True, slots=True)
class LiveViewOptions:
    """Options of a live view in Foxglove."""

    foxglove: Annotated[
        bool, typer.Option("--foxglove", help=f"Show the run live in Foxglove, which connects to {ADDRESS}.")
    ] = False
    foxglove_at: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Show it at this address instead; port 0 for any free one."),
    ] = None

    def open(self, stack: ExitStack, name: str, *, allow_remote: bool = False) -> "FoxgloveServer | None":
        """Open the server, and print its address; None if no live view is wanted.

        Args:
            stack: Context in which it is served.
            name: Name that Foxglove shows.
            allow_remote: Allow connections from other machines.

        Raises:
            MissingExtraError: foxglove-sdk is not installed.
            PortError: The address cannot be listened at, or other machines could reach it.
        """
        if not self.foxglove and self.foxglove_at is None:
            return None
        from khep_twin.ports.network import listening_address

        address = ADDRESS if self.foxglove_at is None else self.foxglove_at
        option = "--allow-remote of khep-twin serve"
        host, port = listening_address(address, "watch the run", allow_remote=allow_remote, option=option)
        from khep_twin.log.foxglove_live import LAYOUT, FoxgloveServer

        server = stack.enter_context(closing(FoxgloveServer(host, port, f"khep_twin {name}")))
        complain(f"Foxglove connects to {server.address}; a layout to import there: {LAYOUT}")
        return server
