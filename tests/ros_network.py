"""A node of ROS 2 by another library, in another process, for tests of nodes on a Zenoh network."""

import json
import queue
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

DOMAIN = 7
"""Domain of ROS of the tests."""

LIMIT = 30.0
"""Longest wait for the other process [s]; machines are as slow as they are."""


class ForeignNode:
    """A node by zenoh-ros2-sdk; its other methods are those of `Commands` in `ros/foreign_node.py`."""

    def __init__(self, address: str) -> None:
        program = Path(__file__).with_name("ros") / "foreign_node.py"
        self._process = subprocess.Popen(
            [sys.executable, str(program), address.rpartition(":")[2], str(DOMAIN)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __enter__(self) -> Self:
        self._read(LIMIT)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()

    def __getattr__(self, command: str) -> Any:
        def ask(**arguments: Any) -> Any:
            self._send(command, arguments)
            answer = self._read(LIMIT)
            assert answer is not None, f"{command}: the foreign node is silent"
            return answer["result"]

        return ask

    def begin_to_hear(self, topic: str) -> Callable[[], str | None]:
        """Return a function that returns the next message of a topic, or None after 10 ms without one."""
        self._send("hear", {"topic": topic})

        def heard() -> str | None:
            return None if (answer := self._read(0.01)) is None else answer["result"]

        return heard

    def _send(self, command: str, arguments: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": command, **arguments}) + "\n")
        self._process.stdin.flush()

    def _read(self, limit: float) -> dict[str, Any] | None:
        output = self._process.stdout
        assert output is not None
        if not select.select([output], [], [], limit)[0]:
            return None
        answer = json.loads(output.readline())
        assert "error" not in answer, answer
        return answer


def free_port() -> int:
    """Return a port number of the loopback interface that nothing uses."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def assert_soon(read: Callable[[], object], expected: object) -> None:
    """Check that a value becomes the expected one, as changes take time to reach another process."""
    deadline = time.monotonic() + LIMIT
    while (value := read()) != expected and time.monotonic() < deadline:
        time.sleep(0.01)
    assert value == expected


class Lines(queue.Queue[str]):
    """Lines that a graph reports."""

    def next(self) -> str:
        """Return the next line, which may be late."""
        return self.get(timeout=LIMIT)

    def all(self) -> list[str]:
        """Return the lines that are there."""
        return [self.get() for _ in range(self.qsize())]
