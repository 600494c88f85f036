"""K213s that are broken on purpose: the conformance checks catch every one of them."""

from contextlib import closing

import pytest
from served_twin import served

from khep_twin.board.k213 import K213Register
from khep_twin.host import Khepera
from khep_twin.lab.conformance.port import vision
from khep_twin.lab.conformance.port.catalogue import CHECKS as ALL
from khep_twin.lab.conformance.port.check import CheckedPort
from khep_twin.lab.conformance.port.conform import run_check
from khep_twin.ports.twin import Twin
from tests.lab.conformance.test_mutants import Mutation, break_answers, is_caught, think, to

CHECKS = [check for check in ALL if check.section == vision.SECTION]


def fields(reply: bytes) -> list[bytes]:
    return reply.rstrip(b"\r\n").split(b",")


def join(parts: list[bytes]) -> bytes:
    return b",".join(parts) + b"\r\n"


ANSWERS: dict[str, Mutation] = {
    "without its number": to("T,2,N", lambda reply: reply.replace(b"t,2,", b"t,")),
    "upper-case letter": to("T,2,N", lambda reply: reply.replace(b",n,", b",N,")),
    "63 pixels": to("T,2,N", lambda reply: join(fields(reply)[:-1])),
    "65 pixels": to("T,2,N", lambda reply: join([*fields(reply), b"0"])),
    "a grey of 256": to("T,2,N", lambda reply: join([*fields(reply)[:-1], b"256"])),
    "a negative grey": to("T,2,N", lambda reply: join([*fields(reply)[:-1], b"-1"])),
    "greys with a comma behind": to("T,2,N", lambda reply: reply.replace(b"\r\n", b",\r\n")),
    "the image in two lines": to("T,2,N", lambda reply: reply.replace(b",", b"\r\n", 9)),
    "M of 64 values": to("T,2,M", lambda reply: join([*fields(reply), *[b"1"] * 32])),
    "light in one number": to("T,2,L", lambda reply: b"t,2,l,200\r\n"),
    "light of ten bits in the low byte": to("T,2,L", lambda reply: b"t,2,l,0,700\r\n"),
    "no version": to("T,2,B", lambda reply: b"t,2,b\r\n"),
    "S of the left half": to("T,2,S", lambda reply: join([b"t", b"2", b"s", *[b"7"] * 32])),
    "T in the other direction": to("T,2,T", lambda reply: join([b"t", b"2", b"t", *fields(reply)[:2:-1]])),
    "Q counted from 1": to("T,2,Q,29", lambda reply: join([b"t", b"2", b"q", *fields(reply)[4:], b"3"])),
    "R of 8 pixels": to("T,2,R,.*", lambda reply: join(fields(reply)[:11])),
    "O of the darkest": to("T,2,O", lambda reply: b"t,2,o,0\r\n"),
    "P beyond the image": to("T,2,P", lambda reply: b"t,2,p,64\r\n"),
    "U without its number": to("T,2,U,.*", lambda reply: b"u\r\n"),
    "U without a reply": to("T,2,U,.*", lambda reply: b""),
    "a ninth period": to("T,2,U,8", lambda reply: b"t,2,u\r\n"),
    "pixels beyond the image": to("T,2,Q,64", lambda reply: join([b"t", b"2", b"q", *[b"NaN"] * 8])),
    "an unknown letter": to("T,2,X", lambda reply: b"t,2,x\r\n"),
    "a wrong parameter": to("T,2,N,1", lambda reply: b"t,2,n,1\r\n"),
    "mirrored": to("T,2,N", lambda reply: join([b"t", b"2", b"n", *fields(reply)[:2:-1]])),
}


def late(twin: Twin) -> None:
    """Waits for 60 ms before its image."""
    think(twin, lambda reply: 60_000_000 if reply.startswith(b"t,2,n") else 0)


def frozen(twin: Twin) -> None:
    """Keeps its first image."""
    twin.robot.turret_bodies["k213"].sense = lambda: None  # type: ignore[method-assign]


def restless(twin: Twin) -> None:
    """Scans in each control period."""
    turret = next(iter(twin.robot.firmware.turrets.values()))
    tick = turret.tick

    def always() -> None:
        tick()
        turret.registers[K213Register.LEFT] = 1

    turret.tick = always  # type: ignore[method-assign]


def with_a_mirror(twin: Twin) -> None:
    """Has its pixels from right to left, in all replies."""
    turret = next(iter(twin.robot.firmware.turrets.values()))
    receive = turret.receive

    def mirrored(message: bytes) -> bytes:
        turret.registers[5:] = turret.registers[:4:-1].copy()
        reply = receive(message)
        turret.registers[5:] = turret.registers[:4:-1].copy()
        return reply

    turret.receive = mirrored  # type: ignore[method-assign]


STRIPES = "khep://stripes?noise=off"
BOARDS = [frozen, restless, with_a_mirror, late]


def deviations(robot: Khepera) -> list[str]:
    line = CheckedPort(robot.port)
    return [result.deviation for check in CHECKS if (result := run_check(check, line)).deviation]


def test_there_are_checks_that_stand_and_one_that_moves() -> None:
    assert len(CHECKS) > 5
    assert [check.moves for check in CHECKS].count("") == len(CHECKS) - 1


@pytest.mark.share(4)
@pytest.mark.parametrize(
    ("noise", "mode", "baudrate"),
    [("on", 3, 38400), ("on", 1, 9600), ("on", 2, 19200), ("off", 3, 38400)],
)
def test_a_sound_k213_passes(noise: str, mode: int, baudrate: int) -> None:
    with closing(Khepera(f"khep://stripes?noise={noise}&mode={mode}", baudrate=baudrate)) as robot:
        assert deviations(robot) == []


def test_a_robot_without_a_k213_passes() -> None:
    with closing(Khepera("khep://default?noise=off")) as robot:
        assert deviations(robot) == []


@pytest.mark.long
def test_a_sound_k213_on_a_pseudo_terminal_passes() -> None:
    with served("stripes", "--mode", "3") as (_, port), Khepera(port, baudrate=38400) as robot:
        texts = deviations(robot)
    # A busy machine may delay a reply.
    assert [text for text in texts if " ms" not in text] == []


@pytest.mark.share(9)
@pytest.mark.parametrize("name", ANSWERS)
def test_a_k213_that_answers_wrongly_is_caught(name: str) -> None:
    assert is_caught(lambda twin: break_answers(twin, ANSWERS[name]), CHECKS, STRIPES)


@pytest.mark.share(2)
@pytest.mark.parametrize("breaking", BOARDS, ids=lambda breaking: breaking.__name__)
def test_a_k213_that_is_broken_inside_is_caught(breaking) -> None:
    def broken(twin: Twin) -> None:
        twin.advance_to(300_000_000)
        breaking(twin)

    assert is_caught(broken, CHECKS, STRIPES)
