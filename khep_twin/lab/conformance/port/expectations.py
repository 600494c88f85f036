"""Expectations of answers, which raise a `Deviation`."""

import re

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation
from khep_twin.units import BITS_PER_BYTE

_FIRST_BYTE = 0.010
"""Longest wait for a reply's first byte after the command's time on the line [s] (hosts tolerate it)."""

_REAL_TIME_SLACK = 0.02
"""Delay by a scheduler that is no fault of the port's [s]."""


def expect_range(request: str, values: list[int], low: int, high: int) -> None:
    """Raise a `Deviation` if a number of a reply is out of range."""
    for value in values:
        if not low <= value <= high:
            raise Deviation(f"{request!r} gave {value}; expected {low} to {high}")


def ask_turret(line: CheckedPort, turret: int, message: str, count: int) -> list[int]:
    """Return the numbers of a turret's answer to a message; raise a `Deviation` unless there are `count`."""
    request = f"T,{turret},{message}"
    return numbers_of_turret(request, line.ask(request), count)


def numbers_of_turret(request: str, answer: str, count: int) -> list[int]:
    """Return the numbers of a turret's answer, none below 0; raise a `Deviation` unless there are `count`."""
    _, turret, letter = request.split(",")[:3]
    head = f"t,{turret},{letter.lower()}"
    if not re.fullmatch(rf"{head}(,(0|[1-9]\d*)){{{count}}}", answer):
        raise Deviation(f"{request!r} was answered {answer!r}; expected {head!r} and {count} numbers")
    return [int(field) for field in answer.split(",")[3:]]


def expect_refusals(line: CheckedPort, *requests: str) -> None:
    """Raise a `Deviation` unless each request is answered by a line that starts with "z,"."""
    for request in requests:
        answer = line.ask(request)
        if not answer.startswith("z,"):
            raise Deviation(f"{request!r} was answered {answer!r}; expected a line that starts with 'z,'")


def expect_in_time(line: CheckedPort, request: str) -> None:
    """Raise a `Deviation` unless the reply begins within 10 ms and takes its bytes' time on the line."""
    byte_time = BITS_PER_BYTE / line.port.baudrate
    slack = 0.0 if hasattr(line.port, "time_ns") else _REAL_TIME_SLACK
    # On a network a reply comes in one piece, with its last byte.
    in_one_piece = str(line.port.port).startswith(("socket:", "rfc2217:"))
    start = line.time()
    line.send(request + "\n")
    first: bytes = line.port.read(1)
    begun = line.time() - start
    rest: bytes = line.port.read_until(b"\n")
    done = line.time() - start
    if not first:
        raise Deviation(f"no reply to {request!r}")
    arrived = len(first + rest) if in_one_piece else 1
    if begun > (len(request) + 1 + arrived) * byte_time + _FIRST_BYTE + slack:
        raise Deviation(f"the first byte of the reply to {request!r} came after {begun * 1000:.1f} ms")
    if done > (len(request) + 1 + len(first + rest)) * byte_time + _FIRST_BYTE + 2 * slack:
        raise Deviation(f"{request!r} and its reply of {len(first + rest)} bytes took {done * 1000:.1f} ms")
