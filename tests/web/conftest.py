"""A designer's server, and a client that sends the requests of a page."""

import base64
import json
import os
import threading
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from khep_twin.web import drafts
from khep_twin.web.server import Server
from tests.web.visit import CHROMIUM, Visit

HANDSHAKE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": base64.b64encode(os.urandom(16)).decode(),
}
"""Headers of a request for a websocket."""


@dataclass
class Client:
    """HTTP client of a designer's server.

    Attributes:
        server: Server.
        end: Function that ends it.
    """

    server: Server
    end: Callable[[], None]

    @property
    def host(self) -> str:
        return urlsplit(self.server.url).netloc

    @property
    def base(self) -> str:
        """Path with the token."""
        return urlsplit(self.server.url).path.rstrip("/")

    def raw(
        self, method: str, path: str, headers: dict[str, str], body: bytes | None = None
    ) -> tuple[int, bytes]:
        connection = HTTPConnection(self.host, timeout=10)
        try:
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in headers.items():
                connection.putheader(name, value)
            if body is not None and "Content-Length" not in headers:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders()
            if body:
                connection.send(body)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

    def headers(self, **changes: str) -> dict[str, str]:
        """Return the headers of the page, with changes."""
        return {
            "Host": self.host,
            "Origin": f"http://{self.host}",
            "Sec-Fetch-Site": "same-origin",
            "Content-Type": "application/json",
            **{name.replace("_", "-"): value for name, value in changes.items()},
        }

    def do(self, action: str, **values: Any) -> tuple[int, Any]:
        status, body = self.raw(
            "POST", f"{self.base}/do/{action}", self.headers(), json.dumps(values).encode()
        )
        return status, json.loads(body) if body[:1] == b"{" else body


@contextmanager
def run_server(
    folder: Path, file: str | None = None, listen: str = "127.0.0.1:0", **options: Any
) -> Generator[Client]:
    """Run a server of a folder in a thread."""
    ended = threading.Event()
    server = Server(folder, file, listen, **options)
    thread = threading.Thread(target=server.serve, args=(ended.is_set,))
    thread.start()

    def end() -> None:
        ended.set()
        thread.join(60)
        assert not thread.is_alive()

    try:
        yield Client(server, end)
    finally:
        end()


@pytest.fixture
def client(tmp_path: Path) -> Iterator[Client]:
    """Client of a server of the test's folder."""
    with run_server(tmp_path) as client:
        yield client


class Inbox:
    """Messages published to a page; a test waits for them."""

    def __init__(self) -> None:
        self.messages: list[Mapping[str, Any]] = []
        self._changed = threading.Condition()

    def __call__(self, message: Mapping[str, Any]) -> None:
        with self._changed:
            self.messages.append(message)
            self._changed.notify_all()

    def wait(self, kind: str, matches: Any = lambda message: True) -> Mapping[str, Any]:
        """Return the next matching message of a kind, and drop it and those before it."""
        n_checked = 0
        with self._changed:
            while True:
                for message in self.messages[n_checked:]:
                    if message["kind"] == kind and matches(message):
                        del self.messages[: self.messages.index(message) + 1]
                        return message
                n_checked = len(self.messages)
                assert self._changed.wait(120), (
                    f"no {kind} among {[message['kind'] for message in self.messages]}"
                )


@pytest.fixture
def inbox() -> Inbox:
    return Inbox()


@pytest.fixture(scope="session")
def playwright() -> Iterator[Any]:
    """Playwright, if it is installed; see `make browser`."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="session")
def browser(playwright: Any) -> Iterator[Any]:
    """Chromium, which has to be installed."""
    software = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *software])
    yield opened
    opened.close()


@pytest.fixture
def empty(monkeypatch: pytest.MonkeyPatch) -> None:
    """New playpens without a robot, as the tests draw robots."""
    monkeypatch.setattr(drafts, "BLANK", drafts.BLANK.partition("[[robot]]")[0])


@pytest.fixture
def visit(browser: Any, empty: None, client: Client) -> Iterator[Visit]:
    """A page of a separate designer, 1280 x 720; its console must stay empty."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    visit = Visit(context.new_page(), client.server.url)
    yield visit
    context.close()
    assert visit.errors == []


@pytest.fixture
def tablet(browser: Any, empty: None, client: Client) -> Iterator[Visit]:
    """A page on a touch screen, 820 x 1180."""
    context = browser.new_context(viewport={"width": 820, "height": 1180}, has_touch=True)
    visit = Visit(context.new_page(), client.server.url)
    yield visit
    context.close()
    assert visit.errors == []
