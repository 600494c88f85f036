"""A designer that listens, and a page that asks it."""

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
class Asker:
    """What a page of the server would ask, and what others would.

    Attributes:
        server: that is asked.
        end: ends it.
    """

    server: Server
    end: Callable[[], None]

    @property
    def host(self) -> str:
        return urlsplit(self.server.url).netloc

    @property
    def base(self) -> str:
        """The path with the token."""
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

    def own(self, **changed: str) -> dict[str, str]:
        """The headers of the page itself."""
        return {
            "Host": self.host,
            "Origin": f"http://{self.host}",
            "Sec-Fetch-Site": "same-origin",
            "Content-Type": "application/json",
            **{name.replace("_", "-"): value for name, value in changed.items()},
        }

    def do(self, action: str, **wanted: Any) -> tuple[int, Any]:
        status, body = self.raw("POST", f"{self.base}/do/{action}", self.own(), json.dumps(wanted).encode())
        return status, json.loads(body) if body[:1] == b"{" else body


@contextmanager
def asked(
    folder: Path, file: str | None = None, listen: str = "127.0.0.1:0", **options: Any
) -> Generator[Asker]:
    """A server of a folder, in a thread of its own."""
    ended = threading.Event()
    server = Server(folder, file, listen, **options)
    thread = threading.Thread(target=server.serve, args=(ended.is_set,))
    thread.start()

    def end() -> None:
        ended.set()
        thread.join(60)
        assert not thread.is_alive()

    try:
        yield Asker(server, end)
    finally:
        end()


@pytest.fixture
def asker(tmp_path: Path) -> Iterator[Asker]:
    """A server in its own folder."""
    with asked(tmp_path) as asker:
        yield asker


class Ear:
    """Hears what is told, and waits for it."""

    def __init__(self) -> None:
        self.heard: list[Mapping[str, Any]] = []
        self._news = threading.Condition()

    def __call__(self, message: Mapping[str, Any]) -> None:
        with self._news:
            self.heard.append(message)
            self._news.notify_all()

    def wait(self, kind: str, fits: Any = lambda message: True) -> Mapping[str, Any]:
        """The next message of a kind that fits."""
        seen = 0
        with self._news:
            while True:
                for message in self.heard[seen:]:
                    if message["kind"] == kind and fits(message):
                        del self.heard[: self.heard.index(message) + 1]
                        return message
                seen = len(self.heard)
                assert self._news.wait(120), f"no {kind} among {[each['kind'] for each in self.heard]}"


@pytest.fixture
def ear() -> Ear:
    return Ear()


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Chromium, where it and Playwright are installed; see `make browser`."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        software = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        opened = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *software])
        yield opened
        opened.close()


@pytest.fixture
def empty(monkeypatch: pytest.MonkeyPatch) -> None:
    """New playpens without a robot, as a test draws its own ones."""
    monkeypatch.setattr(drafts, "BLANK", drafts.BLANK.partition("[[robot]]")[0])


@pytest.fixture
def visit(browser: Any, empty: None, asker: Asker) -> Iterator[Visit]:
    """A page of a separate designer, 1280 x 720; its console has to stay empty."""
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    visit = Visit(context.new_page(), asker.server.url)
    yield visit
    context.close()
    assert visit.trouble == []


@pytest.fixture
def tablet(browser: Any, empty: None, asker: Asker) -> Iterator[Visit]:
    """The same for fingers, 820 x 1180."""
    context = browser.new_context(viewport={"width": 820, "height": 1180}, has_touch=True)
    visit = Visit(context.new_page(), asker.server.url)
    yield visit
    context.close()
    assert visit.trouble == []
