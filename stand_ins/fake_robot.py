"""Fake robots: a table of answers behind a TCP port or a terminal, which can also go silent or disconnect."""

import contextlib
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Self

ANSWERS = {
    "B": "b,5.02,5.01",
    "E": "e,0,0",
    "H": "h,12,-5",
    "I": "i,625",
    "K": "k,1,1,0,1,1,0",
    "N": "n,0,100,200,300,400,500,600,1023",
    "O": "o,500,450,400,300,200,100,50,0",
}


class FakeRobot:
    """Server that answers each line; hosts may connect one after the other.

    Attributes:
        requests: All received lines, in order.
        answers: Answers by letter; other capitals are acknowledged by their lower-case letter.
        silent: Whether it sends nothing.
        prefix: Bytes to send before the next answer, once.
        delay: Time before each answer [s].
    """

    def __init__(self) -> None:
        self.requests: list[str] = []
        self.answers = dict(ANSWERS)
        self.silent = False
        self.prefix = b""
        self.delay = 0.0
        # No stray host of another test uses this address.
        self._server = socket.create_server(("127.7.7.7", 0))
        self._hangs_up = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._serve)
        self.url = f"socket://127.7.7.7:{self._server.getsockname()[1]}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended = True
        self._thread.join()

    def disconnect(self, *, for_good: bool = False) -> None:
        """End the connection, and with `for_good` accept no other."""
        self._ended = for_good
        self._hangs_up.set()
        while self._hangs_up.is_set() and self._thread.is_alive():
            time.sleep(0.01)

    def _serve(self) -> None:
        rest = b""
        client: socket.socket | None = None
        while not self._ended:
            ready = select.select([self._server, *([client] if client else [])], [], [], 0.01)[0]
            if self._server in ready:
                client, _ = self._server.accept()
                rest = b""
            elif ready and client is not None:
                try:
                    data = client.recv(4096)
                except OSError:
                    data = b""
                *lines, rest = (rest + data).split(b"\n")
                self._answer(client, [line.decode("latin-1") for line in lines if line])
                if not data:
                    self._hangs_up.set()
            if self._hangs_up.is_set():
                if client is not None:
                    client.close()
                    client = None
                self._hangs_up.clear()
        if client is not None:
            client.close()
        self._server.close()

    def _answer(self, client: socket.socket, lines: list[str]) -> None:
        for line in lines:
            self.requests.append(line)
            answer = self.answers.get(line[0], line[0].lower()).encode() + b"\r\n"
            prefix, self.prefix = self.prefix, b""
            time.sleep(self.delay)
            if not self.silent:
                with contextlib.suppress(ConnectionError):  # the host has closed the connection
                    client.sendall(prefix + answer)


class TerminalRobot:
    """A fake robot at a pseudo-terminal, which answers each line.

    Args:
        on_request: Function that takes each line when it arrives.

    Attributes:
        requests: All received lines, in order.
        url: Path of the terminal.
    """

    def __init__(self, on_request: Callable[[str], object] = str) -> None:
        self._on_request = on_request
        self.requests: list[str] = []
        self._robot_end, self._host_end = os.openpty()
        tty.setraw(self._host_end)
        self.url = os.ttyname(self._host_end)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.unplug()
        os.close(self._host_end)

    def unplug(self) -> None:
        """Hang up, once."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _serve(self) -> None:
        rest = b""
        while not self._ended.is_set():
            if select.select([self._robot_end], [], [], 0.01)[0]:
                *lines, rest = (rest + os.read(self._robot_end, 4096)).split(b"\n")
                for line in lines:
                    request = line.decode("latin-1")
                    self._on_request(request)
                    self.requests.append(request)
                    answer = ANSWERS.get(request[:1], request[:1].lower())
                    os.write(self._robot_end, f"{answer}\r\n".encode() * bool(request))
        os.close(self._robot_end)
