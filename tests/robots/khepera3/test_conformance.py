"""The checks of a Khepera III: the twin passes all, and each check catches a broken robot."""

import re
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest

from khep_twin.errors import PortError
from khep_twin.host import Khepera3
from khep_twin.lab.conformance.port.check import Check, CheckedPort
from khep_twin.lab.conformance.port.conform import checks, conform, run_check
from khep_twin.robots.khepera3 import conformance
from khep_twin.robots.khepera3.robot import Khepera3Robot

Receive = Callable[[bytes], bytes]
Mutation = Callable[[bytes, Receive], bytes]
"""From a complete line and the sound program to the reply of the broken one."""


def other(pattern: str, replacement: str) -> Mutation:
    """Replies that match are changed."""
    return lambda line, receive: re.sub(pattern.encode(), replacement.encode(), receive(line))


def to(command: str, reply: str) -> Mutation:
    """Lines that match get another reply, and have no other effect."""
    return lambda line, receive: (
        reply.encode() + b"\n\r" if re.fullmatch(command.encode(), line.strip()) else receive(line)
    )


def instead(command: str, replacement: str) -> Mutation:
    """Lines that match are replaced."""
    return lambda line, receive: receive(re.sub(rf"^{command}\b".encode(), replacement.encode(), line))


def silent_server(line: bytes, receive: Receive) -> bytes:
    """Answer as kh3server, without its loss of input."""
    return receive(line).replace(b"\n\r", b"\r\n")


BROKEN: dict[str, tuple[Mutation, ...]] = {
    "line_endings": (
        lambda line, receive: receive(line.replace(b"\r", b"")),
        lambda line, receive: receive(line) if line.strip() else b"$\n\r",
        to("B", "b,5.02,5.01"),
    ),
    "reply_ends": (other("^(e.*)\n\r", r"\1\r\n"), other("\n\r", "\n")),
    "pipelining": (silent_server, to("E", "$")),
    "unknown_commands": (to("b", "b,3,0"), to("Q", "q")),
    "prefixes": (
        instead("I,500,-600", "I,l500,l-600"),
        to(r"I,l12\.75.*", "$"),
        to("I,500,-600", "i"),
        to("I,l5", "i"),
        silent_server,
    ),
    "setters": (other("^h\n", "H\n"), to("C,1,d3", "$"), to("Z", "z,0")),
    "wheels": (to("E", "e,10,0"), to("R", "r,-4464,0")),
    "infrared": (other(r"^n,(-?\d+),-?\d+", r"n,\1"), other(r"^n,-?\d+", "n,4096"), other(r"^o,\d+", "o,-1")),
    "timer": (to("Z", "z"), other(r"(n,.*),\d+\n", r"\1,1\n")),
    "ultrasonic": (to("C,0,d0", "c"), to("C,1,d1", "c"), other(r"^g,1,\d+", "g,1,500"), to("G,3", "g,1,27")),
    "battery": (to("V,0", "v,7051,0"), to("V,3", "v,1350,0"), to("V,6", "v,0,0")),
    "binary": (lambda line, receive: receive(line)[:66], instead("I,l1000,l-2", "I,l-2,l1000")),
    "driven_speed": (instead("D,l10000,l10000", "D,l8000,l8000"), to("E", "e,0,0")),
    "wheel_order": (instead("D,l8000,l-8000", "D,l-8000,l8000"), to("L.*", "l")),
    "targets": (instead("F,l3000,l3000", "F,l2000,l2000"), to("J.*", "j"), to("P.*", "p")),
    "gains": (to("H.*", "h"), to("M", "m")),
    "vehicle": (to("A,0", "a"), to("A,2", "a")),
}
"""Broken programs for each check, by the name of its function."""

WRITTEN = {name: value for name, value in vars(conformance).items() if isinstance(value, Check)}


@pytest.fixture
def robot() -> Iterator[Khepera3]:
    with closing(Khepera3("khep://arena3?noise=off")) as khepera3:
        yield khepera3


def break_program(robot: Khepera3, mutation: Mutation) -> None:
    twin = robot.port.twin.robot  # type: ignore[attr-defined]
    assert isinstance(twin, Khepera3Robot)
    receive, pending = twin.firmware.receive, bytearray()

    def broken(data: bytes) -> bytes:
        pending.extend(data)
        if not data.endswith((b"\r", b"\n")):
            return b""
        line = bytes(pending)
        pending.clear()
        return mutation(line, receive)

    twin.firmware.receive = broken  # type: ignore[method-assign]


@pytest.mark.parametrize("url", ["khep://arena3", "khep://arena3?rom=kh3server"])
def test_the_twin_passes_all_checks_with_either_program(url: str) -> None:
    report = conform(url, move=True, model="khepera3")
    assert report.passed, report.text()
    assert len(report.results) == len(WRITTEN)


def test_each_check_is_listed_once_and_those_that_move_come_last() -> None:
    assert [*conformance.CHECKS] == [*WRITTEN.values()]
    moving = [bool(check.moves) for check in checks(True, "khepera3")]
    assert moving == sorted(moving)
    assert {*BROKEN} == {*WRITTEN}


@pytest.mark.parametrize(
    ("name", "mutation"),
    [
        pytest.param(name, mutation, id=f"{name}-{number}", marks=pytest.mark.long if number else ())
        for name, mutations in BROKEN.items()
        for number, mutation in enumerate(mutations)
    ],
)
def test_a_program_that_answers_otherwise_is_caught(name: str, mutation: Mutation, robot: Khepera3) -> None:
    break_program(robot, mutation)
    assert run_check(WRITTEN[name], CheckedPort(robot.port, robot.dialect.framing)).deviation


def test_a_robot_of_another_kind_is_named() -> None:
    with pytest.raises(PortError, match="the robot is a Khepera IV; expected a Khepera III"):
        conform("khep://arena4", model="khepera3")
