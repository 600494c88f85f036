"""The designer's server: a socket, a token, a guard, and the page behind it."""

import secrets
import socket
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import uvicorn

from khep_twin.errors import PortError
from khep_twin.ports.network import is_loopback, parse_address
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard
from khep_twin.web.routes import Page

MESSAGE_LIMIT = 64 * 1024
"""Longest message that a page may send by its websocket [bytes]."""


class Server:
    """A designer that listens.

    Args:
        folder: whose files it may read and write.
        file: that is opened at first, from the folder on.
        listen: HOST:PORT, port 0 for any that is free.
        expose: whether other machines may reach it.

    Attributes:
        url: of the page, with its token.

    Raises:
        PortError: it cannot listen there, or may not.
    """

    def __init__(self, folder: Path, file: str | None, listen: str, *, expose: bool = False) -> None:
        host, port = parse_address(listen)
        if not is_loopback(host) and not expose:
            raise PortError(
                f"{listen}: other machines could reach your files from there; right is 127.0.0.1:{port}, or "
                "--expose if that is wanted"
            )
        documents = Documents(folder)
        if file is not None:
            documents.path(file, ".toml")
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            raise PortError(f"{listen}: cannot listen there: {error.strerror}") from error
        port = self._socket.getsockname()[1]
        names = {f"[{host}]" if ":" in host else host} | ({"localhost"} if is_loopback(host) else set[str]())
        token = secrets.token_urlsafe(24)
        self.url = f"http://{min(names - {'localhost'}, default='localhost')}:{port}/{token}/"
        self._page = Page(documents, file)
        guard = Guard(self._page.app(), token, {f"{name}:{port}" for name in names})
        self._server = _Quiet(
            uvicorn.Config(
                guard,
                log_level="critical",
                access_log=False,
                lifespan="off",
                server_header=False,
                ws="websockets-sansio",
                ws_max_size=MESSAGE_LIMIT,
                timeout_graceful_shutdown=2,
                h11_max_incomplete_event_size=32 * 1024,
                http="h11",
                loop="asyncio",
            )
        )

    def serve(self, stop: Callable[[], bool]) -> None:
        """Serves until `stop` says so."""
        self._server.stop = stop
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._page.close()
            self._socket.close()


class _Quiet(uvicorn.Server):
    """Leaves signals to who has started it, and asks whether to go on."""

    stop: Callable[[], bool]

    @contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Captures none."""
        yield

    async def on_tick(self, counter: int) -> bool:
        """Whether to end, asked ten times a second."""
        return self.stop() or await super().on_tick(counter)
