"""Checks of robots with letters: the twins pass all, and each check catches a broken robot."""

import re
from collections.abc import Callable
from contextlib import closing

import pytest

from khep_twin.errors import PortError
from khep_twin.host.host_robot import open_robot
from khep_twin.lab.conformance.port.check import CheckedPort
from khep_twin.lab.conformance.port.conform import checks, conform, run_check
from khep_twin.robots.registry import find_model

Receive = Callable[[bytes], bytes]
Mutation = Callable[[bytes, Receive], bytes]
"""From a complete line and the sound program to the reply of the broken one."""

PLAYPENS = {"khepera3": "arena3", "khepera4": "arena4"}


def other(pattern: str, replacement: str) -> Mutation:
    """Replies that match are changed."""
    return lambda line, receive: re.sub(pattern.encode(), replacement.encode(), receive(line))


def to(command: str, reply: str) -> Mutation:
    """Lines that match get another reply, and have no other effect."""
    return lambda line, receive: (
        reply.encode() + receive(b"B\n")[-2:]
        if re.fullmatch(command.encode(), line.strip())
        else receive(line)
    )


def instead(command: str, replacement: str) -> Mutation:
    """Lines that match are replaced."""
    return lambda line, receive: receive(re.sub(rf"^{command}\b".encode(), replacement.encode(), line))


def without_returns(line: bytes, receive: Receive) -> bytes:
    return receive(line.replace(b"\r", b""))


def answering_empty_lines(line: bytes, receive: Receive) -> bytes:
    return receive(line) if line.strip() else b"$" + receive(b"B\n")[-2:]


def silent_server(line: bytes, receive: Receive) -> bytes:
    """Answer as kh3server, without its loss of input."""
    return receive(line).replace(b"\n\r", b"\r\n")


def cut(line: bytes, receive: Receive) -> bytes:
    return receive(line)[:66]


BROKEN: dict[str, dict[str, tuple[Mutation, ...]]] = {
    "khepera4": {
        "B reads": (without_returns, answering_empty_lines, to("B", "b,5.02,5.01")),
        "of commands sent together": (lambda line, receive: receive(line),),
        "bytes sent one": (to("P,20", "$"),),
        "unknown commands": (
            *(to("n", "n,0"), to(".*!.*", "b,B,0"), to("V,-1", "v,0"), to("K,1,2,3", "k"), to("A,3", "a")),
        ),
        "numbers are parsed": (to("V,,7", "$"), instead("V,65541", "V,0")),
        "only the first 82": (to("K,.{80,}", "$"),),
        "H, J, P": (other("^h\r", "H\r"), to("K,64,.*", "$"), to("A,2", "$")),
        "E reads": (to("E", "e,10,0"), to("R", "r,100,0")),
        "N reads": (other(r"^n,(\d+),\d+", r"n,\1"),),
        "O reads": (other(r"^o,\d+", "o,1024"),),
        "G reads": (to("U,4", "u"),),
        "S reads": (other(r"^s,-?\d+", "s,4000"),),
        "T reads": (
            other(r"^t,(-?\d+,){10}", "t," + "0," * 9 + "-16384,"),
            other(r"^(t(,-?\d+){29}),.*", r"\1,0\r"),
        ),
        "V reads": (to("V,4", "v,25"), to("V,0", "v,262400"), to("V,5", "v,101")),
        "X reads": (
            *(cut, other("(?s)^(x.{56}).", r"\1d"), other("(?s)^(x.{46}).", r"\1d"), other("^x.", "xd")),
        ),
        "Z resets": (to("Z", "z"), other(r"^g,\d+", "g,2000")),
        "D drives": (instead("D,200,200", "D,100,100"), to("E", "e,0,0"), to("R", "r,0,0")),
        "D and L": (instead("D,200,-200", "D,-200,200"), instead("L,600,-600", "L,-600,600")),
        "F drives": (instead("F,30000,30000", "F,10000,10000"), to("J.*", "j")),
        "H sets": (to("H.*", "h"), to("M", "m"), to("Z", "z")),
        "A drives": (to("A,0", "a"), to("A,2", "a"), to("A,1", "a"), to("A,3", "$"), instead("A,2", "A,3")),
    },
    "khepera3": {
        "B reads": (without_returns, answering_empty_lines, to("B", "b,5.02,5.01")),
        "all replies": (other("^(e.*)\n\r", r"\1\r\n"), other("\n\r", "\n")),
        "of commands sent together": (silent_server, to("E", "$")),
        "an unknown command": (to("b", "b,3,0"), to("Q", "q"), to("V,6", "v,0,0")),
        "numbers of more": (
            *(instead("I,500,-600", "I,l500,l-600"), to(r"I,l12\.75.*", "$"), to("I,500,-600", "i")),
            *(to("I,l5", "i"), silent_server),
        ),
        "commands that set": (other("^h\n", "H\n"), to("C,1,d3", "$"), to("Z", "z,0")),
        "E reads": (to("E", "e,10,0"), to("R", "r,-4464,1000")),
        "N and O": (
            *(other(r"^n,(-?\d+),-?\d+", r"n,\1"), other(r"^n,-?\d+", "n,4096"), other(r"^o,\d+", "o,-1")),
        ),
        "the last value": (to("Z", "z"), other(r"(n,.*),\d+\n", r"\1,1\n")),
        "G reads": (
            *(to("C,0,d0", "c"), to("C,1,d1", "c"), other(r"^g,1,\d+", "g,1,500"), to("G,3", "g,1,27")),
        ),
        "V reads": (to("V,0", "v,7051,0"), to("V,3", "v,1350,0")),
        "X reads": (cut, instead("I,l-70000,l1000", "I,l1000,l-70000")),
        "D drives": (instead("D,l10000,l10000", "D,l8000,l8000"), to("E", "e,0,0"), to("R", "r,0,0")),
        "D and L": (instead("D,l10000,l-10000", "D,l-10000,l10000"), to("L.*", "l")),
        "F drives": (instead("F,l3000,l3000", "F,l2000,l2000"), to("J.*", "j"), to("P.*", "p")),
        "H sets": (to("H.*", "h"), to("M", "m")),
        "A drives": (to("A,0", "a"), to("A,2", "a")),
    },
}
"""Broken programs for each check, by the start of its name."""


@pytest.mark.parametrize(
    ("url", "model"),
    [("arena4", "khepera4"), ("arena3", "khepera3"), ("arena3?rom=kh3server", "khepera3")],
)
def test_the_twin_passes_all_checks(url: str, model: str) -> None:
    report = conform(f"khep://{url}", move=True, model=model)
    assert report.passed, report.text()
    assert len(report.results) == len(BROKEN[model])


@pytest.mark.parametrize("model", BROKEN)
def test_each_check_is_listed_once_and_those_that_move_come_last(model: str) -> None:
    names = [check.name for check in checks(True, model)]
    assert [sum(name.startswith(start) for name in names) for start in BROKEN[model]] == [1] * len(names)
    moving = [bool(check.moves) for check in checks(True, model)]
    assert moving == sorted(moving)


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("model", "start", "mutation"),
    [
        pytest.param(model, start, mutation, marks=pytest.mark.long if number else ())
        for model, mutations_of in BROKEN.items()
        for start, mutations in mutations_of.items()
        for number, mutation in enumerate(mutations)
    ],
)
def test_a_program_that_answers_otherwise_is_caught(model: str, start: str, mutation: Mutation) -> None:
    (check,) = (check for check in checks(True, model) if check.name.startswith(start))
    with closing(open_robot(find_model(model), f"khep://{PLAYPENS[model]}?noise=off")) as robot:
        program = robot.port.twin.robot.firmware  # type: ignore[attr-defined]
        if start == "of commands sent together":  # a server that answers immediately loses nothing
            program.answer_ns = 0
        receive, pending = program.receive, bytearray()

        def broken(data: bytes) -> bytes:
            pending.extend(data)
            if not data.endswith((b"\r", b"\n")):
                return b""
            line = bytes(pending)
            pending.clear()
            return mutation(line, receive)

        program.receive = broken
        assert run_check(check, CheckedPort(robot.port, robot.dialect.framing)).deviation


@pytest.mark.parametrize(
    ("url", "model", "message"),
    [
        ("default", "khepera4", "the robot is a Khepera; expected a Khepera IV"),
        ("arena4", "khepera3", "the robot is a Khepera IV; expected a Khepera III"),
    ],
)
def test_a_robot_of_another_kind_is_named(url: str, model: str, message: str) -> None:
    with pytest.raises(PortError, match=message):
        conform(f"khep://{url}", model=model)
