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
from khep_twin.web.connections import ACCEPTED_AT_ONCE, PING, QUEUE, PageConnection, Watch, reported
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard
from khep_twin.web.routes import Page

_ANY = ("0.0.0.0", "::")
"""Hosts that mean all of a machine's addresses."""

MESSAGE_LIMIT = 64 * 1024
"""Longest message of a page over its websocket [bytes]."""


class Server:
    """Server of the designer.

    Attributes:
        url: URL of its page, with its token.
        url_once: URL that leads to the page once, for the browser's arguments.

    Args:
        folder: Folder whose files the page may read and write.
        file: File to open at first, relative to the folder.
        listen: HOST:PORT; port 0 is any free port.
        allow_remote: Allow connections from other machines.
        complain: Function that takes the server's own errors, a line each; without it, they are logged.

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
        complain: Callable[[str], object] | None = None,
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
        names = _names(host)
        token, once = (secrets.token_urlsafe(24) for _ in range(2))
        self.url = f"http://{names[0]}:{port}/{token}/"
        self.url_once = f"http://{names[0]}:{port}/{once}/"
        self._page = Page(documents, file, writes_programs=is_loopback(host))
        self._complain = complain
        hosts = {f"{name}:{port}" for name in names}
        guard = Guard(self._page.app(), token, hosts, once=once, complain=complain)
        self._server = _Quiet(
            uvicorn.Config(
                guard,
                log_config=None,
                log_level="error",
                access_log=False,
                lifespan="off",
                server_header=False,
                ws="websockets-sansio",
                ws_max_size=MESSAGE_LIMIT,
                ws_ping_interval=PING,
                ws_ping_timeout=PING,
                backlog=ACCEPTED_AT_ONCE,
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
            with reported(self._complain):
                self._server.run(sockets=[self.listener])
        finally:
            self._page.close()
            self.listener.close()


def _names(host: str) -> list[str]:
    """Return the names that a browser may use for the listening host; the first is that of the URL."""
    if is_loopback(host):
        return [_bracketed(host)] if host == "localhost" else [_bracketed(host), "localhost"]
    if host not in _ANY:
        return [_bracketed(host)]
    own = {socket.gethostname()}
    with suppress(OSError):
        own |= {str(found[4][0]) for found in socket.getaddrinfo(socket.gethostname(), None)}
    outwards = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        # Sends nothing: only looks up the route.
        probe.connect(("192.0.2.1", 9))
        outwards = [probe.getsockname()[0]]
    others = [_bracketed(name.partition("%")[0]) for name in sorted(own)]
    return list(dict.fromkeys([*outwards, *others, "127.0.0.1", "localhost"]))


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


class _Quiet(uvicorn.Server):
    """Server that leaves signals to its caller, polls `stop`, and watches its connections."""

    stop: Callable[[], bool]

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self._watch = Watch()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start listening."""
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(QUEUE)  # which asyncio makes as short as what it accepts at once

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Capture no signals."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """Return whether to end; called ten times a second."""
        self._watch.look(self.server_state.connections, time.monotonic())
        return self.stop() or await super().on_tick(counter)
