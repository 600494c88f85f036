"""The page is answered in spite of incomplete requests, peers that read nothing, and many connections."""

import asyncio
import logging
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from websockets.sync.client import connect
from websockets.typing import Origin

from khep_twin.web import connections
from khep_twin.web.connections import report_errors
from tests.web.conftest import HANDSHAKE, Client


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time limits of 0.3 s; requested before the server."""
    monkeypatch.setattr(connections, "LONGEST_S", dict.fromkeys(connections.LONGEST_S, 0.3))


@pytest.fixture
def opened(client: Client) -> Iterator[Callable[[bytes], socket.socket]]:
    """Function that opens a connection and sends data."""
    host, _, port = client.host.rpartition(":")
    with ExitStack() as stack:

        def open_connection(data: bytes) -> socket.socket:
            connection = stack.enter_context(socket.create_connection((host, int(port)), timeout=30))
            connection.sendall(data)
            return connection

        yield open_connection


def head(client: Client, method: str, path: str, **changed: str) -> bytes:
    lines = [f"{name}: {value}" for name, value in {**client.headers(), **changed}.items()]
    return "\r\n".join([f"{method} {client.base}{path} HTTP/1.1", *lines, "", ""]).encode()


def ended(connection: socket.socket) -> bool:
    """Return True if the server ends a connection before the connection's timeout."""
    try:
        while connection.recv(65536):
            pass
    except ConnectionResetError:
        pass
    return True


def is_closed(connection: socket.socket, data: bytes) -> bool:
    """Return whether the server has ended a connection, to which data are sent."""
    try:
        connection.sendall(data)
        return not connection.recv(65536)
    except TimeoutError:
        return False
    except (BrokenPipeError, ConnectionResetError):
        return True


@pytest.mark.usefixtures("impatient")
def test_half_of_a_request_is_not_waited_for(
    client: Client, opened: Callable[[bytes], socket.socket]
) -> None:
    post = head(client, "POST", "/do/check", **{"Content-Length": "100"})
    halves = [b"", b"G", b"GET / HTTP/1.1\r\nHost: x\r\n", post, post + b'{"draft"']
    for connection in [opened(half) for half in halves]:
        assert ended(connection)


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("body", [False, True])
def test_a_request_that_comes_a_byte_at_a_time_is_not_waited_for(
    client: Client, opened: Callable[[bytes], socket.socket], body: bool
) -> None:
    post = head(client, "POST", "/do/check", **{"Content-Length": "10000"})
    connection = opened(post if body else post[:20])
    connection.settimeout(0.05)
    assert any(is_closed(connection, b"x") for _ in range(1000))


@pytest.mark.usefixtures("impatient")
def test_a_connection_that_asks_nothing_more_is_ended(
    client: Client, opened: Callable[[bytes], socket.socket]
) -> None:
    connection = opened(head(client, "GET", "/"))
    assert connection.recv(12) == b"HTTP/1.1 200"
    assert ended(connection)


@pytest.mark.usefixtures("impatient")
def test_a_peer_that_takes_no_answer_is_is_closed(client: Client) -> None:
    host, _, port = client.host.rpartition(":")
    # The kernel must not buffer the whole answer.
    client.server.listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect((host, int(port)))
        connection.sendall(head(client, "GET", "/static/main.js") * 100)
        assert connection.recv(4, socket.MSG_PEEK) == b"HTTP"
        deadline = time.monotonic() + 30
        while client.server.connections and time.monotonic() < deadline:
            time.sleep(0.05)
        received = b"".join(iter(lambda: connection.recv(65536), b""))
        assert 0 < received.count(b"HTTP/1.1 200") < 100


def test_requests_that_come_much_faster_than_they_are_answered_are_not_kept(
    client: Client, opened: Callable[[bytes], socket.socket]
) -> None:
    connection = opened(head(client, "GET", "/"))
    assert any(is_closed(connection, head(client, "GET", "/") * 500) for _ in range(100))


def test_requests_in_one_piece_are_answered_one_by_one(
    client: Client, opened: Callable[[bytes], socket.socket]
) -> None:
    connection = opened(
        (head(client, "POST", "/do/check", **{"Content-Length": "13"}) + b'{"draft": {}}') * 50
    )
    answers = b""
    while answers.count(b"HTTP/1.1 200") < 50:
        data = connection.recv(65536)
        assert data
        answers += data


def test_connections_that_send_nothing_keep_no_page_out(
    client: Client, opened: Callable[[bytes], socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "connection_limit", lambda: 4)
    idle = [opened(b"GET / HTTP/1.1\r\nHost: x\r\n") for _ in range(20)]
    assert client.do("hello")[0] == 200
    # The oldest connections are closed first; the latest ones stay open.
    assert all(ended(connection) for connection in idle[:16])


def test_with_few_descriptors_the_page_is_answered_and_at_most_a_line_is_reported(tmp_path: Path) -> None:
    program = [sys.executable, "-m", "khep_twin", "design", "--no-browser"]
    with (
        subprocess.Popen(
            ["/bin/sh", "-c", 'ulimit -n 64; exec "$@"', "sh", *program],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process,
        ExitStack() as stack,
    ):
        assert process.stdout is not None
        assert process.stderr is not None
        url = process.stdout.readline().strip()
        host, key = url.split("/")[2:4]
        name, _, port = host.rpartition(":")

        def send(data: bytes) -> socket.socket:
            connection = stack.enter_context(socket.create_connection((name, int(port)), timeout=30))
            connection.sendall(data)
            return connection

        for _ in range(3):
            for _ in range(60):
                send(b"GET / HTTP/1.1\r\nHost: x\r\n")
            page = f"GET /{key}/ HTTP/1.1\r\nHost: {host}\r\nSec-Fetch-Site: none\r\n\r\n"
            assert send(page.encode()).recv(12) == b"HTTP/1.1 200"
        process.terminate()
        assert process.wait(60) == 0
        announced, *lines = process.stderr.read().splitlines()
        assert announced.endswith("Ctrl-C ends it")
        assert lines == [
            "khep-twin: the page: all 16 connections are taken; the one that is idle the longest is ended"
        ]


def test_a_server_without_a_descriptor_waits_and_reports_a_line(tmp_path: Path) -> None:
    program = """
import os, time
from pathlib import Path
from khep_twin.web.server import Server

server = Server(Path.cwd(), None, "127.0.0.1:0", report=lambda text: print(text, flush=True))
full = []

def stop():
    if not full:
        try:
            while True:
                os.dup(0)
        except OSError:
            full.append((time.monotonic(), time.process_time()))
            print(server.url, flush=True)
    return os.path.exists("stop")

server.serve(stop)
begin, used = full[0]
print(time.process_time() - used < 0.5 * (time.monotonic() - begin))
"""
    with (
        subprocess.Popen(
            ["/bin/sh", "-c", 'ulimit -n 64; exec "$@"', "sh", sys.executable, "-c", program],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stdin=subprocess.DEVNULL,
            text=True,
        ) as process,
        ExitStack() as stack,
    ):
        assert process.stdout is not None
        host, _, port = process.stdout.readline().split("/")[2].rpartition(":")
        for _ in range(5):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=30))
        line = process.stdout.readline()
        time.sleep(1.5)
        (tmp_path / "stop").touch()
        assert process.wait(60) == 0
        assert line == (
            "the page: socket.accept() out of system resource: OSError: [Errno 24] Too many open files\n"
        )
        # No further line was printed, and the processor was idle.
        assert process.stdout.read() == "True\n"


def test_a_websocket_stays_open_as_long_as_its_page_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.setattr("khep_twin.web.server.PING_S", 0.2)
    monkeypatch.setattr(connections, "LONGEST_S", dict.fromkeys(connections.LONGEST_S, 0.3))
    client: Client = request.getfixturevalue("client")
    host, _, port = client.host.rpartition(":")
    origin = Origin(f"http://{client.host}")
    with (
        connect(f"ws://{client.host}{client.base}/live", origin=origin, ping_interval=None) as alive,
        socket.create_connection((host, int(port)), timeout=30) as dead,
    ):
        dead.sendall(head(client, "GET", "/live", **HANDSHAKE))
        assert ended(dead)
        time.sleep(0.5)
        alive.ping().wait(30)
        assert alive.state.name == "OPEN"


def test_an_error_of_the_server_is_a_line_and_the_same_again_is_none() -> None:
    lines: list[str] = []
    logger = logging.getLogger("uvicorn.error")
    with report_errors(lines.append):
        for number in range(3):
            try:
                raise OSError(24, f"no descriptor {number}")
            except OSError as error:
                logger.error("Exception in ASGI application\n", exc_info=error)
        logger.error("another %s", "trouble")
        logger.error("stopped", exc_info=asyncio.CancelledError())
    assert lines == [
        "the page: Exception in ASGI application: OSError: [Errno 24] no descriptor 0",
        "the page: another trouble",
    ]
