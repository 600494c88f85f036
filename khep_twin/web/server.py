"""The designer's server: socket, token, guard and page."""

import secrets
import socket
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path

import uvicorn

from khep_twin.errors import PortError
from khep_twin.ports.network import is_loopback, listening_address
from khep_twin.web.connections import ACCEPT_BATCH, BACKLOG, PING_S, PageConnection, Watchdog, report_errors
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard
from khep_twin.web.routes import Page

_WILDCARD_HOSTS = ("0.0.0.0", "::")

MESSAGE_LIMIT = 64 * 1024
"""Longest message of a page over its websocket [bytes]."""


class Server:
    """Server of the designer.

    Attributes:
        url: URL of its page, with its token.
        one_time_url: URL that leads to the page once, for the browser's arguments.

    Args:
        folder: Folder whose files the page may read and write.
        file: File to open first, relative to the folder.
        listen: HOST:PORT; port 0 is any free port.
        allow_remote: Allow connections from other machines.
        report: Function that takes the server's errors, a line each; None to log them.

    Raises:
        PortError: The server cannot or may not listen there.
    """

    def __init__(
        self,
        folder: Path,
        file: str | None,
        listen: str,
        *,
        allow_remote: bool = False,
        report: Callable[[str], object] | None = None,
    ) -> None:
        host, port = listening_address(listen, "reach your files", allow_remote=allow_remote)
        documents = Documents(folder)
        if file is not None:
            documents.check(file)
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self.listener = socket.create_server((host, port), family=family, dualstack_ipv6=host == "::")
        except OSError as error:
            reason = (error.strerror or str(error)).partition(" (while")[0]
            raise PortError(f"{listen}: cannot listen there: {reason}") from error
        port = self.listener.getsockname()[1]
        names = _host_names(host)
        token, one_time_token = (secrets.token_urlsafe(24) for _ in range(2))
        self.url = f"http://{names[0]}:{port}/{token}/"
        self.one_time_url = f"http://{names[0]}:{port}/{one_time_token}/"
        self._page = Page(documents, file, writes_programs=is_loopback(host))
        self._report = report
        hosts = {f"{name}:{port}" for name in names}
        guard = Guard(self._page.app(), token, hosts, one_time_token=one_time_token, report=report)
        self._server = _PolledServer(
            uvicorn.Config(
                guard,
                log_config=None,
                log_level="error",
                access_log=False,
                lifespan="off",
                server_header=False,
                ws="websockets-sansio",
                ws_max_size=MESSAGE_LIMIT,
                ws_ping_interval=PING_S,
                ws_ping_timeout=PING_S,
                backlog=ACCEPT_BATCH,
                timeout_graceful_shutdown=2,
                h11_max_incomplete_event_size=32 * 1024,
                http=PageConnection,
                loop="asyncio",
            )
        )

    @property
    def connections(self) -> int:
        """Number of open connections."""
        return len(self._server.server_state.connections)

    def serve(self, stop: Callable[[], bool]) -> None:
        """Serve until `stop` returns True."""
        self._server.stop = stop
        try:
            with report_errors(self._report):
                self._server.run(sockets=[self.listener])
        finally:
            self._page.close()
            self.listener.close()


def _host_names(host: str) -> list[str]:
    """Return the names that a browser may use for the listening host; the first is that of the URL."""
    if is_loopback(host):
        return [_bracketed(host)] if host == "localhost" else [_bracketed(host), "localhost"]
    if host not in _WILDCARD_HOSTS:
        return [_bracketed(host)]
    names = {socket.gethostname()}
    with suppress(OSError):
        names |= {str(address[4][0]) for address in socket.getaddrinfo(socket.gethostname(), None)}
    outgoing = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        # Sends nothing: only looks up the route.
        probe.connect(("192.0.2.1", 9))
        outgoing = [probe.getsockname()[0]]
    hosts = [_bracketed(name.partition("%")[0]) for name in sorted(names)]
    return list(dict.fromkeys([*outgoing, *hosts, "127.0.0.1", "localhost"]))


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


class _PolledServer(uvicorn.Server):
    """Server that leaves signals to its caller, polls `stop`, and checks its connections."""

    stop: Callable[[], bool]

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._watchdog = Watchdog()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening."""
        await super().startup(sockets)
        for listener in sockets or ():
            listener.listen(BACKLOG)  # asyncio sets it to `backlog`

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Capture no signals."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """Return whether to end; called ten times a second."""
        self._watchdog.check(self.server_state.connections, time.monotonic())
        return self.stop() or await super().on_tick(counter)
