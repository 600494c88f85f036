"""Endpoints of `khep-twin serve`: what hosts open, and how it is printed and listed."""

import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.options import complain, usage
from khep_twin.errors import PortError
from khep_twin.machine import is_writable

if TYPE_CHECKING:
    from khep_twin.ports.host_port import HostPort


@dataclass(frozen=True, slots=True)
class EndpointOptions:
    """Endpoints that hosts open."""

    link: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Make this link to the pseudo-terminal; the path to open is printed. NAME alone lies in a "
            "private directory, $XDG_RUNTIME_DIR/khep_twin; ./NAME lies in the current directory.",
        ),
    ] = None
    tcp: Annotated[str | None, typer.Option(help="Serve TCP at HOST:PORT, for socket://HOST:PORT.")] = None
    rfc2217: Annotated[
        str | None, typer.Option(help="Serve RFC 2217 at HOST:PORT, for rfc2217://HOST:PORT.")
    ] = None
    allow_remote: Annotated[
        bool,
        typer.Option("--allow-remote", help="Let other machines reach ports on the network, too."),
    ] = False
    ready_fd: Annotated[
        int | None, typer.Option(help="Write what hosts open to this descriptor, too, and close it.")
    ] = None

    def open(self, bauds: Mapping[int, int]) -> AbstractContextManager[Sequence["HostPort"]]:
        """Open one cable for each robot, by the speeds of their lines."""
        from khep_twin.ports.endpoints import open_endpoints

        return open_endpoints(
            bauds, link=self.link, tcp=self.tcp, rfc2217=self.rfc2217, allow_remote=self.allow_remote
        )

    @contextmanager
    def announced(self, ports: Sequence["HostPort"], what: str) -> Generator[None]:
        """List what is served for `khep-twin ports`; print what hosts open, to the descriptor, too."""
        from khep_twin.ports.service_registry import registered

        with ExitStack() as stack:
            try:
                stack.enter_context(registered([port.path for port in ports], what))
            except PortError as error:
                complain(f"not listed by khep-twin ports: {error}")
            complain(f"serving a {what}; hosts open what the next lines name; Ctrl-C ends it")
            paths = "".join(f"{port.path}\n" for port in ports)
            typer.echo(paths, nl=False)
            if self.ready_fd is not None:
                try:
                    with os.fdopen(self.ready_fd, "w") as file:
                        file.write(paths)
                except OSError as error:
                    raise usage(f"--ready-fd {self.ready_fd}: cannot be written: {error.strerror}") from None
            yield

    def check(self) -> None:
        """Refuse a descriptor that is not open for writing."""
        descriptor = self.ready_fd
        if descriptor is None:
            return
        wanted = "expected 3 or above, of what is open for writing, such as --ready-fd 3 3>ready"
        if not 3 <= descriptor < 2**31:
            raise usage(f"--ready-fd {descriptor}: {wanted}")
        try:
            # What this process has opened itself is not passed on to others.
            given = os.get_inheritable(descriptor)
            writable = is_writable(descriptor)
        except OSError:
            given = writable = False
        if not (given and writable):
            raise usage(f"--ready-fd {descriptor}: is not open{' for writing' if given else ''}; {wanted}")
