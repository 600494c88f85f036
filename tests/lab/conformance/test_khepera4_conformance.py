"""The checks of a Khepera IV: the twin passes all, and each check catches a broken robot."""

import re
from collections.abc import Callable, Iterator
from contextlib import closing

import pytest

from khep_twin.errors import PortError
from khep_twin.host import Khepera4
from khep_twin.lab.conformance.port.check import Check, CheckedPort
from khep_twin.lab.conformance.port.conform import checks, conform, run_check
from khep_twin.robots.khepera4.conformance import catalogue, commands, grammar, motion
from khep_twin.robots.khepera4.robot import Khepera4Robot

Receive = Callable[[bytes], bytes]
Mutation = Callable[[bytes, Receive], bytes]
"""From a complete line and the sound server to the reply of the broken one."""


def other(pattern: str, replacement: str) -> Mutation:
    """Replies that match are changed."""
    return lambda line, receive: re.sub(pattern.encode(), replacement.encode(), receive(line))


def to(command: str, reply: str) -> Mutation:
    """Lines that match get another reply, and have no other effect."""
    return lambda line, receive: (
        reply.encode() + b"\r\n" if re.fullmatch(command.encode(), line.strip()) else receive(line)
    )


def instead(command: str, replacement: str) -> Mutation:
    """Lines that match are replaced."""
    return lambda line, receive: receive(re.sub(rf"^{command}\b".encode(), replacement.encode(), line))


def cut(line: bytes, receive: Receive) -> bytes:
    return receive(line)[:67]


BROKEN: dict[str, Mutation] = {
    "line_endings": lambda line, receive: receive(line.replace(b"\r", b"")),
    "empty_lines": lambda line, receive: receive(line) if line.strip() else b"$\r\n",
    "single_bytes": to("P,20", "$"),
    "pipelining": lambda line, receive: receive(line),
    "unknown_commands": to("n", "n,0"),
    "numbers_of_c": to("V,,7", "$"),
    "long_line": to("K,.{80,}", "$"),
    "rubbish": to(".*!.*", "b,B,0"),
    "revision": to("B", "b,5.02,5.01"),
    "setters": other("^h\r", "H\r"),
    "speeds": to("E", "e,10,0"),
    "positions": to("R", "r,100,0"),
    "proximity": other(r"^n,(\d+),\d+", r"n,\1"),
    "ambient": other(r"^o,\d+", "o,1024"),
    "ultrasonic": to("U,4", "u"),
    "gyroscope": other(r"^s,-?\d+", "s,4000"),
    "accelerometer": other(r"^t,(-?\d+,){10}", "t," + "0," * 9 + "-16384,"),
    "battery": to("V,4", "v,25"),
    "voltage": to("V,0", "v,262400"),
    "other_kinds": to("V,-1", "v,0"),
    "leds": to("K,1,2,3", "k"),
    "refused_vehicles": to("A,3", "a"),
    "binary": cut,
    "reset": to("Z", "z"),
    "driven_speed": instead("D,200,200", "D,100,100"),
    "wheel_order": instead("D,150,-150", "D,-150,150"),
    "targets": instead("F,30000,30000", "F,10000,10000"),
    "profile": to("J.*", "j"),
    "gains": to("H.*", "h"),
    "open_loop": instead("L,600,600", "L,-600,600"),
    "idle": to("M", "m"),
    "reset_in_motion": to("Z", "z"),
    "vehicle": to("A,0", "a"),
    "refused_vehicle": to("A,3", "$"),
}
"""A broken server for each check, by the name of its function."""

WRITTEN = {
    name: value
    for module in (grammar, commands, motion)
    for name, value in vars(module).items()
    if isinstance(value, Check)
}


@pytest.fixture
def robot() -> Iterator[Khepera4]:
    with closing(Khepera4("khep://arena4?noise=off")) as khepera4:
        yield khepera4


def break_server(robot: Khepera4, mutation: Mutation) -> None:
    twin = robot.port.twin.robot  # type: ignore[attr-defined]
    assert isinstance(twin, Khepera4Robot)
    receive, pending = twin.firmware.receive, bytearray()

    def broken(data: bytes) -> bytes:
        pending.extend(data)
        if not data.endswith((b"\r", b"\n")):
            return b""
        line = bytes(pending)
        pending.clear()
        return mutation(line, receive)

    twin.firmware.receive = broken  # type: ignore[method-assign]


def test_the_twin_passes_all_checks() -> None:
    report = conform("khep://arena4", move=True, model="khepera4")
    assert report.passed, report.text()
    assert len(report.results) == len(WRITTEN)


def test_each_check_is_listed_once_and_those_that_move_come_last() -> None:
    assert sorted(check.name for check in catalogue.CHECKS) == sorted(
        check.name for check in WRITTEN.values()
    )
    moving = [bool(check.moves) for check in checks(True, "khepera4")]
    assert moving == sorted(moving)
    assert {*BROKEN} == {*WRITTEN}


@pytest.mark.parametrize("name", BROKEN)
def test_a_server_that_answers_otherwise_is_caught(name: str, robot: Khepera4) -> None:
    if name == "pipelining":  # a server that answers immediately loses nothing
        robot.port.twin.robot.firmware.answer_ns = 0  # type: ignore[attr-defined]
    break_server(robot, BROKEN[name])
    assert run_check(WRITTEN[name], CheckedPort(robot.port)).deviation


def test_a_robot_of_the_other_kind_is_named() -> None:
    with pytest.raises(PortError, match="the robot is a Khepera; expected a Khepera IV"):
        conform("khep://default", model="khepera4")
