"""The conformance checks on robots with a radio: sound ones pass, broken ones are caught."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from radio_scene import playpen_with_radios
from scenes import hosted
from served_twin import served
from test_mutants import Mutation, Receive, break_answers, is_caught, receive_by, replies, to
from test_recording import changed, checked, failed
from test_recording import to as recorded_to

from khep_twin import playpen
from khep_twin.host import Khepera, commands
from khep_twin.lab.conformance.port.check import CheckedPort
from khep_twin.lab.conformance.port.conform import checks, examine, run_check
from khep_twin.lab.experiment.multi_robot import run_together
from khep_twin.log.recorded import read_recorded_run
from khep_twin.ports.twin import Twin, TwinOptions

PAIR = playpen_with_radios([(200, 250), (400, 250)])
CHECKS = [check for check in checks(False) if "radio" in check.name]


def status(change: Callable[[int], int]) -> Mutation:
    """Every status is changed."""
    return lambda line, reply: re.sub(
        rb"^t,4,f,(\d+)", lambda match: b"t,4,f,%d" % change(int(match.group(1))), reply
    )


RADIOS: dict[str, Mutation] = {
    "without its number": to("T,4,F", lambda reply: reply.replace(b"t,4,", b"t,")),
    "one version": to("T,4,B", lambda reply: b"t,4,b,1\r\n"),
    "a version with a point": to("T,4,B", lambda reply: b"t,4,b,1.0,0\r\n"),
    "no status": to("T,4,F", lambda reply: b"z,Protocol error\r\n"),
    "a status in words": to("T,4,F", lambda reply: b"t,4,f,ready\r\n"),
    "a status of many bits": status(lambda bits: bits | 64),
    "never ready": status(lambda bits: bits & ~1),
    "always ready": status(lambda bits: bits | 1),
    "no failure": status(lambda bits: bits & ~4),
    "always failed": status(lambda bits: bits | 4),
    "always a message": status(lambda bits: bits | 2),
    "silent without a message": to("T,4,R", lambda reply: b""),
    "no zeros without a message": to("T,4,R", lambda reply: b"t,4,r\r\n"),
    "fifteen bytes": to("T,4,R", lambda reply: reply.rpartition(b",")[0] + b"\r\n"),
    "seventeen bytes": to("T,4,R", lambda reply: reply.replace(b"\r\n", b",0\r\n")),
    "a length of seventeen": to("T,4,R", lambda reply: b"t,4,r,1,17" + b",0" * 16 + b"\r\n"),
    "a byte of nine bits": to("T,4,R", lambda reply: b"t,4,r,1,16" + b",256" * 16 + b"\r\n"),
    "a sent message with an echo": replies("^t,4,s\r", "t,4,s,1\r"),
    "long messages taken": to(r"T,4,S,\d+,17,.*", lambda reply: b"t,4,s\r\n"),
    "short orders taken": to(r"T,4,S,255,1,2", lambda reply: b"t,4,s\r\n"),
    "no radio beyond a byte": to(r"T,4,S,256,.*", lambda reply: b"t,4,s\r\n"),
    "bytes beyond a byte": to(r"T,4,S,255,1,256,.*", lambda reply: b"t,4,s\r\n"),
    "unknown orders taken": to("T,4,Q", lambda reply: b"t,4,q\r\n"),
    "no message to all": to("T,4,S,-1,.*", lambda reply: b"z,Protocol error\r\n"),
    "a second message taken": replies("^z,Radio is sending", "t,4,s"),
}


def deaf_to_restarts(twin: Twin) -> None:
    """Continues to send after a restart."""
    for turret in twin.robot.firmware.turrets.values():
        turret.reset = lambda: None  # type: ignore[method-assign]


def without_power(twin: Twin) -> None:
    """Takes messages and never sends them."""
    for turret in twin.robot.firmware.turrets.values():
        turret.tick = lambda: None  # type: ignore[method-assign]


def lost(twin: Twin) -> None:
    """Sends a refused message."""

    def answer(receive: Receive, data: bytes) -> bytes:
        reply = receive(data)
        if re.fullmatch(rb"T,4,S,255,17,.*\n", data):
            receive(data.replace(b",17,", b",16,"))
        return reply

    receive_by(twin, answer)


@pytest.mark.share(9)
@pytest.mark.parametrize("name", RADIOS)
def test_a_radio_that_answers_wrongly_is_caught(name: str) -> None:
    assert is_caught(lambda twin: break_answers(twin, RADIOS[name]), CHECKS, hosted(PAIR, noise=False))


@pytest.mark.share(2)
@pytest.mark.parametrize("breaking", [deaf_to_restarts, lost, without_power])
def test_a_radio_that_is_broken_inside_is_caught(breaking: Callable[[Twin], None]) -> None:
    assert is_caught(breaking, CHECKS, hosted(PAIR, noise=False))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The playpen in a file."""
    path = tmp_path_factory.mktemp("playpen") / "radios.toml"
    path.write_text(playpen.dump(PAIR))
    return path


@pytest.mark.share(3)
@pytest.mark.parametrize(("mode", "baudrate"), [(3, 38400), (1, 9600), (2, 19200)])
def test_a_robot_with_a_radio_conforms(path: Path, mode: int, baudrate: int) -> None:
    with Khepera(f"khep://{path}?mode={mode}", baudrate=baudrate) as robot:
        report = examine(CheckedPort(robot.port), "a radio")
    assert report.passed, report.text()


@pytest.mark.long
def test_a_served_robot_with_a_radio_conforms(path: Path) -> None:
    with served(str(path)) as (_, port), Khepera(port.split()[-1]) as robot:
        deviations = [run_check(check, CheckedPort(robot.port)).deviation for check in CHECKS]
    assert deviations == [""] * len(CHECKS) == [""] * 6


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two robots, of which one sends faster than its radio."""

    def sends(robot: Khepera) -> None:
        for number in range(4):
            robot.burst(commands.proximity(), commands.position())
            robot.ask(f"T,4,S,2,1,{number}" + ",0" * 15)
            robot.ask("T,4,F")
        robot.ask("T,4,S,2,17" + ",0" * 16)

    def reads(robot: Khepera) -> None:
        for _ in range(8):
            robot.sleep(0.1)
            robot.ask("T,4,R")

    path = tmp_path_factory.mktemp("log") / "run.mcap"
    slow = playpen_with_radios([(200, 250), (400, 250)], "[radio]\nair_time_ms = 200\n")
    run_together(slow, [sends, reads], TwinOptions(seed=1, log=str(path)))
    return path


def test_a_recording_of_sound_radios_has_no_finding(log: Path, tmp_path: Path) -> None:
    lines = [line.text for line in read_recorded_run(log).lines[0]]
    assert {"z,Radio is sending", "t,4,s", "z,Protocol error"} <= {text.strip() for text in lines}
    assert failed(checked(changed(log, tmp_path / "same.mcap", lambda lines: lines))) == []


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("T,4,F", "z,Radio is sending"),
        ("T,4,F", "t,4,f,1,0"),
        ("T,4,S,2,17.*", "t,4,s"),
        ("T,4,S,2,17.*", "z,Radio is sending"),
        ("T,4,S,2,1,0.*", "t,4,s,1"),
        ("T,4,S,2,1,0.*", "z,Protocol error"),
    ],
)
def test_a_recording_of_a_wrong_radio_is_caught(log: Path, tmp_path: Path, command: str, reply: str) -> None:
    wrong = changed(log, tmp_path / "wrong.mcap", recorded_to(command, reply))
    assert "a turret answers under its number, an absent one is refused" in failed(checked(wrong))
