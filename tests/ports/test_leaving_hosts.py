"""Network hosts that leave within a line or negotiation: the next one is served soon, with no stale byte.

The suite runs some of them; `KHEP_LEAVINGS=1000` runs 1,000 at a port of each kind and requires an answer
within half a second, as `make long LONG=leavings` does.
"""

import os
import random
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Sequence

import pytest
from served_twin import Dialect, all_of, connected, robots, served, stop

LEAVINGS = int(os.environ.get("KHEP_LEAVINGS", "25"))
MOST_S = 0.5 if "KHEP_LEAVINGS" in os.environ else 10.0
"""Longest wait of the next host: in the suite the machine is busy; on the line 20 kB take 22 s."""

GREETING = {"--tcp": b"", "--rfc2217": bytes.fromhex("fffb01 fffb03 fffd00 fffb2c")}
SPEED = bytes.fromhex("fffa2c 01 00002580 fff0")

KILLED = "import os, socket, sys, time; host = socket.socket(fileno=int(sys.argv[1])); time.sleep(100)"
"""A process that shares a host's connection."""


def flood(host: socket.socket, data: bytes, size: int) -> None:
    """Send repeated data until there is no room."""
    host.setblocking(False)
    try:
        for _ in range(-(-size // 10_000)):
            host.sendall((data * (10_000 // len(data) + 1))[: min(size, 10_000)])
    except (BlockingIOError, ConnectionError):
        pass


def fall_silent(host: socket.socket, rng: random.Random) -> None:
    """Send no bytes."""


def ask(host: socket.socket, rng: random.Random) -> None:
    """Send commands and leave the replies unread."""
    host.sendall(b"N\nO\nH\n" * rng.randint(1, 20))
    time.sleep(rng.choice([0, 0.005, 0.05]))


def begin_a_line(host: socket.socket, rng: random.Random) -> None:
    """Send a part of a command."""
    host.sendall(rng.choice([b"G,12", b"N\nG,9", b"L,0,1\nD,", b"restart", b"\n\nB"]))
    time.sleep(rng.choice([0, 0.005]))


def negotiate(host: socket.socket, rng: random.Random) -> None:
    """Send a part of a negotiation, which a port without RFC 2217 treats as plain bytes."""
    host.sendall((SPEED * 3)[: rng.randint(1, 30)])


def negotiate_wrongly(host: socket.socket, rng: random.Random) -> None:
    """Send an invalid negotiation."""
    host.sendall(rng.choice([b"\xff\xf0", b"N\n\xff\xfa\x2c\x01\x01\xff\xf0N\n", b"\xff\xfa" + bytes(400)]))


def flood_a_little(host: socket.socket, rng: random.Random) -> None:
    flood(host, rng.choice([b"N\n", b"L,0,1\n", b"x", b"\n", b"restart\n", SPEED]), 20_000)


def flood_a_lot(host: socket.socket, rng: random.Random) -> None:
    flood(host, rng.choice([b"N\n", b"L,0,1\n", b"x", b"\n", b"restart\n", SPEED]), 1_000_000)


def close(host: socket.socket) -> None:
    host.close()


def reset(host: socket.socket) -> None:
    host.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    host.close()


def finish(host: socket.socket) -> None:
    """Finish sending, but keep reading: it is closed when the next host has been served."""
    try:
        host.shutdown(socket.SHUT_WR)
    except OSError:
        pass  # the server has cut it off


def die(host: socket.socket) -> None:
    """Kill the last process that has the connection."""
    command = [sys.executable, "-S", "-E", "-c", KILLED, str(host.fileno())]
    with subprocess.Popen(command, pass_fds=[host.fileno()]) as process:
        host.close()
        process.kill()


DEEDS = [fall_silent, ask, begin_a_line, negotiate, negotiate_wrongly, flood_a_little, flood_a_lot]
LEAVES = [close, close, reset, reset, finish, die]


def served_next(url: str, requests: bytes, expected: bytes) -> tuple[float, bytes]:
    """Return the time [s] that the next host waits for its replies, and all bytes that it gets."""
    start, replies = time.monotonic(), b""
    with connected(url) as host:
        host.sendall(requests)
        while len(replies) < len(expected) and (chunk := host.recv(1000)):
            replies += chunk
    return time.monotonic() - start, replies


@pytest.mark.parametrize(("kind", "robot"), robots("KHEP_LEAVINGS", ["--tcp", "--rfc2217"]))
def test_the_host_after_one_that_left_is_served_at_once_with_no_stale_byte(kind: str, robot: Dialect) -> None:
    rng = random.Random(5)
    times: list[float] = []
    with served(robot.playpen, kind, "127.0.0.1:0") as (process, url):
        for count in range(LEAVINGS):
            requests, expected = (b"".join(lines) for lines in zip(*robot.exchanges(count), strict=True))
            deed, leave = rng.choice(DEEDS), rng.choice(LEAVES)
            with connected(url) as first:
                deed(first, rng)
                leave(first)
                time.sleep(rng.choice([0, 0, 0.0005, 0.005, 0.03]))
                waited, replies = served_next(url, requests, GREETING[kind] + expected)
            named = (count, deed.__name__, leave.__name__)
            assert replies == GREETING[kind] + expected, (named, replies)
            assert waited < MOST_S, (named, waited)
            times.append(waited)
        code, errors = stop(process)
    assert code == 0
    assert "Traceback" not in errors
    print(f"{kind}, {robot.playpen}: {LEAVINGS} hosts left; the next waited {max(times):.3f} s at most")


@pytest.mark.share(3)
@pytest.mark.parametrize(
    "how", [["--tcp"], ["--unpaced", "--rfc2217"], ["--clock", "wire", "--tcp"]], ids=" ".join
)
def test_a_host_that_has_finished_sending_gets_all_its_replies(how: Sequence[str]) -> None:
    with served("default", *how, ":0") as (_, url):
        check_finished_hosts(url, GREETING[how[-1]])


def test_a_host_that_has_finished_sending_gets_all_its_replies_through_a_relay() -> None:
    with (
        served("default", "--unpaced") as (_, device),
        served("--relay", device, "--tcp", ":0") as (_, url),
    ):
        check_finished_hosts(url, b"")


def check_finished_hosts(url: str, greeting: bytes) -> None:
    """Check that hosts that behave as `nc -N` get all replies, and then the end of the connection."""
    sent = b"B\n" * 20 + b"C,12"
    # The rest of the third takes longer on the line than the reply, and on the wire clock never crosses it.
    for lines in (sent, sent, b"D,0,0\nD,12345"):
        with connected(url) as port:
            port.sendall(lines)
            port.shutdown(socket.SHUT_WR)
            replies = all_of(port)
        assert replies == greeting + (b"b,5.02,5.01\r\n" * 20 if lines is sent else b"d\r\n")
