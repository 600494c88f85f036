"""Boards that are broken on purpose: the conformance checks catch every one of them."""

import re
from collections.abc import Callable, Iterable
from contextlib import closing
from typing import Any

import pytest

from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.host import Khepera
from khep_twin.lab.conformance.port.check import Check, CheckedPort
from khep_twin.lab.conformance.port.conform import checks, run_check
from khep_twin.ports.twin import Twin

DEFAULT = "khep://default?noise=off"
Mutation = Callable[[bytes, bytes], bytes]
"""From a complete command line and its replies to the replies of the broken board."""


def replies(pattern: str, replacement: str) -> Mutation:
    """Every reply that matches is changed."""
    return lambda line, reply: re.sub(pattern.encode(), replacement.encode(), reply)


def to(command: str, answer: Callable[[bytes], bytes]) -> Mutation:
    """Replies to lines that match are changed."""
    return lambda line, reply: answer(reply) if re.fullmatch(command.encode(), line.strip()) else reply


def swap(reply: bytes, first: int, second: int) -> bytes:
    """Exchanges two fields of a reply."""
    fields = reply.rstrip(b"\r\n").split(b",")
    fields[first], fields[second] = fields[second], fields[first]
    return b",".join(fields) + b"\r\n"


def in_order(reply: bytes, order: list[int]) -> bytes:
    """A reply with its values in another order."""
    head, *values = reply.rstrip(b"\r\n").split(b",")
    return b",".join([head, *(values[index] for index in order)]) + b"\r\n"


ANSWERS: dict[str, Mutation] = {
    "replies end in LF only": replies("\r\n", "\n"),
    "replies end in CR only": replies("\r\n", "\r"),
    "an empty line behind each reply": replies("\r\n$", "\r\n\r\n"),
    "a prompt behind each reply": replies("\r\n$", "\r\n> "),
    "a blank after each comma": replies(",", ", "),
    "upper-case replies": lambda line, reply: reply.upper(),
    "the command is echoed": lambda line, reply: line.strip() + b"\r\n" + reply if reply else reply,
    "nine sensors": to("[NO]", lambda reply: reply.replace(b"\r\n", b",0\r\n")),
    "seven sensors": to("[NO]", lambda reply: reply.rpartition(b",")[0] + b"\r\n"),
    "O answers with n": replies("^o,", "n,"),
    "eleven-bit sensors": to("N", lambda reply: b"n,1500,0,0,0,0,0,0,0\r\n"),
    "negative light": to("O", lambda reply: b"o,-5,0,0,0,0,0,0,0\r\n"),
    "B has two fields": replies("^b,5.02,5.01", "b,5.02"),
    "B has a blank": replies("^b,5.02,5.01", "b,5.02,5.01 "),
    "unknown words get z": replies("^Command not found", "z,Command not found"),
    "unknown words are ignored": lambda line, reply: b"" if reply.startswith(b"Command") else reply,
    "protocol errors with a dot": replies("^z,Protocol error\r", "z,Protocol error.\r"),
    "protocol errors are ignored": lambda line, reply: b"" if reply.startswith(b"z,Prot") else reply,
    "J with two arguments": to(r"J,\d+,\d+", lambda reply: b"j\r\n"),
    "silent on an empty turret": to("T,.*", lambda reply: b""),
    "a turret without its number": to("T,1,B", lambda reply: b"t,b,1,2\r\n"),
    "K with three fields": replies(r"^k,(\d),(\d),(-?\d+),.*", r"k,\1,\2,\3\r\n"),
    "K with an unknown mode": replies(r"^k,(\d),\d", r"k,\1,7"),
    "speeds as decimals": replies(r"^e,(-?\d+),(-?\d+)", r"e,\1.0,\2.0"),
    "hexadecimal counters": to("H", lambda reply: b"h,0x0,0x0\r\n"),
    "left and right counters exchanged": to("H", lambda reply: swap(reply, 1, 2)),
    "an LED that does not exist is switched": to("L,5,0", lambda reply: b"l\r\n"),
    "no LED 1": to("L,1,.*", lambda reply: b"z,Protocol error\r\n"),
    "no converter channel 5": to("I,5", lambda reply: b"z,Protocol error\r\n"),
    "extra parameters are ignored": to(r"D,1,2,3", lambda reply: b"d\r\n"),
    "restart without a banner": to("restart", lambda reply: b"ok\r\n"),
    "a reply in eight bits": replies("^c\r\n", "c\xff\r\n"),
    "lower-case commands are accepted": to("d,5,5", lambda reply: b"d\r\n"),
    "sensors from right to left": to("N", lambda reply: in_order(reply, [7, 6, 5, 4, 3, 2, 1, 0])),
    "sensors from the front": to("N", lambda reply: in_order(reply, [2, 3, 4, 5, 6, 7, 0, 1])),
    "left and right sensors exchanged": to("N", lambda reply: in_order(reply, [5, 4, 3, 2, 1, 0, 7, 6])),
    "front and back sensors exchanged": to("N", lambda reply: in_order(reply, [0, 1, 6, 7, 4, 5, 2, 3])),
    "K has the right wheel first": to("K", lambda reply: in_order(reply, [3, 4, 5, 0, 1, 2])),
    "K with no error": replies(r"^k,(\d),(\d),-?\d+,(\d),(\d),-?\d+", r"k,\1,\2,0,\3,\4,0"),
    "no negative targets": to(r"C,-\d+,.*", lambda reply: b"z,Protocol error\r\n"),
    "silent at help": to("help", lambda reply: b""),
    "list is not known": to("list", lambda reply: b"Command not found\r\n"),
    "tools in lines that end in LF": to("net|process|memory", lambda reply: reply.replace(b"\r", b"")),
    "numbers with leading zeros": replies(r",(\d)\b", r",0\1"),
    "no number at all": to("H", lambda reply: b"h,--5,5\r\n"),
    "silent on letters that are no commands": to("[SUVXYZ]", lambda reply: b""),
    "K with an invented error": replies(r"^k,(\d),1,-?\d+", r"k,\1,1,4711"),
    "sensor values in two lines": to("N", lambda reply: reply.replace(b",", b"\r\n", 4)),
}


def break_answers(twin: Twin, mutation: Mutation) -> None:
    """Let a mutation change the replies of the firmware."""
    firmware, pending = twin.robot.firmware, bytearray()
    receive_sound = firmware.receive

    def receive(data: bytes) -> bytes:
        pending.extend(data)
        reply = receive_sound(data)
        if data.endswith((b"\r", b"\n")):
            line = bytes(pending)
            pending.clear()
            return mutation(line, reply) if line.strip(b"\r\n") else reply
        return reply

    firmware.receive = receive  # type: ignore[method-assign]


Receive = Callable[[bytes], bytes]


def receive_by(twin: Twin, answer: Callable[[Receive, bytes], bytes]) -> None:
    """Replace the firmware's `receive` by `answer`, which is called with the original function."""
    receive = twin.robot.firmware.receive
    twin.robot.firmware.receive = lambda data: answer(receive, data)  # type: ignore[method-assign]


def think(twin: Twin, delay_ns: Callable[[bytes], int]) -> None:
    """Delay each reply by a time that depends on it [ns]."""
    send = twin.robot.uart.tx.send
    twin.robot.uart.tx.send = (  # type: ignore[method-assign]
        lambda data, time_ns: send(data, time_ns + delay_ns(data))
    )


def late(twin: Twin) -> None:
    """Waits for 60 ms before each reply."""
    think(twin, lambda reply: 60_000_000)


def slow_line(twin: Twin) -> None:
    """Sends at a quarter of the line's speed."""
    tx = twin.robot.uart.tx
    send = tx.send

    def put_slowly(data: bytes, time_ns: int) -> int:
        tx.baud = 2400
        return send(data, time_ns)

    tx.send = put_slowly  # type: ignore[method-assign]


def deaf_to_cr(twin: Twin) -> None:
    """Knows LF only."""
    receive_by(twin, lambda receive, data: receive(data.replace(b"\r", b" ")))


def crossed_wheels(twin: Twin) -> None:
    """Drives the left motor for the right one."""
    robots: Any = twin.world.simulation.plain.groups[0]
    robots[0] = robots[0]._replace(motors=robots[0].motors[::-1])


def backwards(twin: Twin) -> None:
    """Counts the encoders backwards, and also drives backwards."""
    twin.world.model.actuator_gear[:] *= -1


def lame(twin: Twin) -> None:
    """Has no current for its motors."""
    twin.world.model.actuator_gear[:] = 1e-9


def keeps_settings(twin: Twin) -> None:
    """Shows the banner at a restart, and resets nothing."""
    firmware = twin.robot.firmware
    firmware.reset = lambda: b"ROM of minirobot KHEPERA\r\n"  # type: ignore[method-assign]


def counts_in_sixteen_bits(twin: Twin) -> None:
    """Has counters of sixteen bits."""
    register_view = twin.robot.firmware.register_view

    def narrow(receive: Receive, data: bytes) -> bytes:
        for wheel in (LEFT, RIGHT):
            position = register_view[wheel + Wheel.POSITION]
            register_view[wheel + Wheel.POSITION] = (position + 2**15) % 2**16 - 2**15
        return receive(data)

    receive_by(twin, narrow)


def never_there(twin: Twin) -> None:
    """Never reports a reached target."""
    register_view = twin.robot.firmware.register_view

    def on_the_way(receive: Receive, data: bytes) -> bytes:
        register_view[LEFT + Wheel.ON_TARGET] = 0
        return receive(data)

    receive_by(twin, on_the_way)


def without_trapezoid(twin: Twin) -> None:
    """Goes to its targets at full speed."""
    register_view = twin.robot.firmware.register_view

    def rush(receive: Receive, data: bytes) -> bytes:
        reply = receive(data)
        for wheel in (LEFT, RIGHT):
            register_view[wheel + Wheel.MAX_SPEED], register_view[wheel + Wheel.ACCELERATION] = 100, 10_000
        return reply

    receive_by(twin, rush)


def keep(twin: Twin, *registers: Wheel) -> None:
    """Let a reset keep some registers of both wheels."""
    firmware, register_view = twin.robot.firmware, twin.robot.firmware.register_view
    reset = firmware.reset

    def reset_partly() -> bytes:
        saved = {
            wheel + register: register_view[wheel + register]
            for wheel in (LEFT, RIGHT)
            for register in registers
        }
        banner = reset()
        for register, value in saved.items():
            register_view[register] = value
        return banner

    firmware.reset = reset_partly  # type: ignore[method-assign]


def keeps_its_trapezoid(twin: Twin) -> None:
    """Resets everything but the trapezoid."""
    keep(twin, Wheel.MAX_SPEED, Wheel.ACCELERATION)


def tells_the_setpoint(twin: Twin) -> None:
    """Answers E with the setpoints."""
    register_view = twin.robot.firmware.register_view

    def answer(receive: Receive, data: bytes) -> bytes:
        reply = receive(data)
        speeds = (register_view[LEFT + Wheel.SPEED_SETPOINT], register_view[RIGHT + Wheel.SPEED_SETPOINT])
        return b"e,%d,%d\r\n" % speeds if reply.startswith(b"e,") else reply

    receive_by(twin, answer)


def stops_at_a_renumbering(twin: Twin) -> None:
    """Stops its motors at G."""

    def stop(receive: Receive, data: bytes) -> bytes:
        reply = receive(data)
        if reply == b"g\r\n":
            receive(b"D,0,0\n")
        return reply

    receive_by(twin, stop)


def keeps_driving(twin: Twin) -> None:
    """Restarts with its motors running."""
    keep(twin, Wheel.SPEED_SETPOINT)


def ignores_profiles(twin: Twin) -> None:
    """Acknowledges J and keeps its profile."""
    pattern = re.compile(rb"J(,\d+){4}\s*")
    receive_by(twin, lambda receive, data: b"j\r\n" if pattern.fullmatch(data) else receive(data))


def shows_its_banner_late(twin: Twin) -> None:
    """Waits for 0.6 s before it restarts."""
    think(twin, lambda reply: 600_000_000 if reply.startswith(b"ROM") else 0)


def is_slow_but_at_n(twin: Twin) -> None:
    """Waits for 60 ms, but not before the reply to N."""
    think(twin, lambda reply: 0 if reply.startswith(b"n,") else 60_000_000)


BOARDS = [
    tells_the_setpoint,
    stops_at_a_renumbering,
    keeps_driving,
    ignores_profiles,
    shows_its_banner_late,
    is_slow_but_at_n,
    keeps_its_trapezoid,
    late,
    slow_line,
    deaf_to_cr,
    crossed_wheels,
    backwards,
    lame,
    keeps_settings,
    counts_in_sixteen_bits,
    never_there,
    without_trapezoid,
]


GRIPPERS: dict[str, Mutation] = {
    "a gripper without its number": to("T,1,H.*", lambda reply: reply.replace(b"t,1,", b"t,")),
    "a gripper that repeats the request": to("T,1,H,1", lambda reply: reply.replace(b"h,", b"h,1,")),
    "a gripper that does not know its barrier": to("T,1,G", lambda reply: b"z,Protocol error\r\n"),
    "a gripper with a stuck arm": to("T,1,H,1", lambda reply: b"t,1,h,152\r\n"),
    "a gripper with stuck fingers": to("T,1,H,0", lambda reply: b"t,1,h,100\r\n"),
    "a gripper with a barrier beyond its converter": to("T,1,G", lambda reply: b"t,1,g,9999\r\n"),
    "a gripper that is silent": to("T,1,D,1", lambda reply: b""),
}


def is_caught(
    break_board: Callable[[Twin], None], candidates: Iterable[Check], url: str | Khepera = DEFAULT
) -> bool:
    """Return whether a check finds a deviation."""
    with closing(Khepera(url) if isinstance(url, str) else url) as robot:
        break_board(robot.port.twin)
        line = CheckedPort(robot.port)
        return any(run_check(check, line).deviation for check in candidates)


@pytest.mark.share(3)
@pytest.mark.parametrize("name", [*GRIPPERS, "sound"])
def test_a_gripper_that_answers_wrongly_is_caught(name: str) -> None:
    gripper = [check for check in checks(True) if check.turret == 1]
    mutation = GRIPPERS.get(name, lambda line, reply: reply)
    caught = is_caught(lambda twin: break_answers(twin, mutation), gripper, "khep://gripper?noise=off")
    assert caught == (name != "sound")


@pytest.mark.long
def test_a_sound_board_passes() -> None:
    assert not is_caught(lambda twin: None, checks(True))


@pytest.mark.share(9)
@pytest.mark.parametrize("name", ANSWERS)
def test_a_board_that_answers_wrongly_is_caught(name: str) -> None:
    assert is_caught(lambda twin: break_answers(twin, ANSWERS[name]), checks(True))


@pytest.mark.share(9)
@pytest.mark.parametrize("breaking", BOARDS, ids=lambda breaking: breaking.__name__)
def test_a_board_that_is_broken_inside_is_caught(breaking: Callable[[Twin], None]) -> None:
    assert is_caught(breaking, checks(True))
