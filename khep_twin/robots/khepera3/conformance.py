"""Checks of a Khepera III at a port, with its firmware or kh3server, which the end of a reply tells apart.

Sections are those of the manual; "server" is the published program, "assumed" the twin's choice.
"""

import re

from khep_twin.lab.conformance.port.check import Catalogue, Check, CheckedPort, Deviation, check, expect_range
from khep_twin.lab.conformance.port.driving import STOPPING, drive, drive_to, expect_standing
from khep_twin.robots.khepera3.channels import PULSES_PER_SPEED, ULTRASONIC
from khep_twin.robots.khepera3.model import COUNTS_LIMIT

FORWARD, SPIN = "drives up to 20 cm forwards and back", "turns on the spot"
ANYWHERE = "drives for 1 s without commands, around obstacles"

_VERSION = re.compile(r"b,\d+,\d+")
_ENDS = b"\n\r", b"\r\n"
"""Ends of replies of the firmware (manual) and of kh3server (program)."""

_ROUND_S = 0.6
"""Time in which every ultrasonic sensor measures more than twice [s]."""

_BINARY_BYTES, _NEAR_PULSES = 67, 60
"""Bytes of X's reply; largest distance from its target of a wheel that has stopped: ten margins."""


def _is_server(line: CheckedPort) -> bool:
    """Return whether kh3server answers."""
    line.send("B\n")
    reply = line.framing.read(line.port, line.time)
    if not reply.endswith(_ENDS):
        raise Deviation(f"'B' was answered {reply!r}; expected a line that ends in LF CR or CR LF")
    return reply.endswith(_ENDS[1])


def _expect(line: CheckedPort, pattern: str | re.Pattern[str], *requests: str) -> None:
    """Raise a `Deviation` unless the reply to each request matches."""
    for request in requests:
        if not re.fullmatch(pattern, answer := line.ask(request)):
            raise Deviation(f"{request!r} was answered {answer!r}; expected {pattern!r}")


@check("B reads the version; a command may end in LF, CR or CR LF, and empty lines get no reply", "5.3")
def line_endings(line: CheckedPort) -> None:
    for end in ("\n", "\r", "\r\n", "\n\r\n\r"):
        line.send("B" + end)
        if not _VERSION.fullmatch(answer := line.reply("B")):
            raise Deviation(f"{'B' + end!r} was answered {answer!r}; expected a reply such as 'b,3,0'")
        line.expect_silence(f"after the reply to {'B' + end!r}")


@check("all replies end alike, in LF CR or CR LF", "A")
def reply_ends(line: CheckedPort) -> None:
    end = _ENDS[_is_server(line)]
    for request in ("E", "N", "Q", "V,0"):
        line.send(request + "\n")
        if not (reply := line.framing.read(line.port, line.time)).endswith(end):
            raise Deviation(f"{request!r} was answered {reply!r}; expected the end {end!r}")


@check("of commands sent together the firmware answers each, kh3server the first", "server")
def pipelining(line: CheckedPort) -> None:
    requests = ("B",) if _is_server(line) else ("B", "E", "E")
    line.send("B\nE\nE\n")
    for request in requests:
        if not (answer := line.reply(request)).startswith(request.lower() + ","):
            raise Deviation(f"{request!r} among commands sent together was answered {answer!r}")
    line.expect_silence("after the replies to commands sent together")


@check("an unknown command is answered with $", "server")
def unknown_commands(line: CheckedPort) -> None:
    _expect(line, r"\$", "Q", "S", "T", "W", "Y", "b", "hello", "0", "?", "$")


@check("numbers of more than 8 bits need a prefix; decimals and further ones are ignored", "A", at_rest=True)
def prefixes(line: CheckedPort) -> None:
    line.order("D,l0,l0", "I,l12.75,l-3.2")
    _expect(line, "r,12,-3", "R")
    line.order("I,l500,l-600" + ",0" * 60)
    _expect(line, "r,500,-600", "R")
    if _is_server(line):  # blanks the first character
        line.order("I,500,-600")
        _expect(line, "r,0,600", "R")
    else:
        _expect(line, r"\$", "I,500,-600", "I,d40000,d70000", "I,l5", "I")
        _expect(line, "r,500,-600", "R")


@check("all commands that set something are acknowledged", "A", at_rest=True)
def setters(line: CheckedPort) -> None:
    line.order("D,l0,l0", "I,l0,l0", "F,l0,l0", "P,l0,l0", "L,l0,l0", "C,0,d4", "C,1,d3", "K,0,1", "K,0,2")
    line.order("K,1,0", "H,d1,d600,d30,d20", "H,d0,d620,d10,d3", "J,d15000,d30", "A,2", "M", "D,l0,l0", "Z")


@check("E reads speeds, which are 0 at rest, and R the positions that I sets", "A", at_rest=True)
def wheels(line: CheckedPort) -> None:
    line.order("D,l0,l0", pause=STOPPING)
    line.order("I,l-70000,l0")
    _expect(line, "e,0,0", "E")
    _expect(line, "r,-70000,0", "R")


@check("N and O read eleven values of 12 bits", "A, commands N and O")
def infrared(line: CheckedPort) -> None:
    values = line.numbers("N", 12)[:11]
    # kh3server sends negative noise as unsigned numbers.
    expect_range("N", [value - 0x10000 if value & 0x8000 else value for value in values], -50, COUNTS_LIMIT)
    expect_range("O", line.numbers("O", 12)[:11], 0, COUNTS_LIMIT)


@check("the last value of N is the time since Z in ms", "A, command Z")
def timer(line: CheckedPort) -> None:
    line.sleep(0.4)
    line.order("Z", pause=1.0)
    expect_range("N", line.numbers("N", 12)[11:], 850, 1150)


@check("G reads up to five echoes of an active sensor, none of another one", "A, commands C and G")
def ultrasonic(line: CheckedPort) -> None:
    for mask, limit in ((0, 3), (31, 1), (6, 5), (31, 3), (4, 3)):
        line.order(f"C,0,d{mask}", f"C,1,d{limit}", pause=_ROUND_S)
        for sensor in range(len(ULTRASONIC)):
            count, *numbers, _ = line.numbers(f"G,{sensor + 1}", 17)
            distances, most = numbers[::3], limit if mask >> sensor & 1 else 0
            is_sound = count <= most and all(20 <= cm <= 400 for cm in distances[:count])
            if not is_sound or any(numbers[3 * count :]) or distances[:count] != sorted(distances[:count]):
                given = f"with C,0,d{mask} and C,1,d{limit} G,{sensor + 1} gave {count} echoes, {numbers}"
                raise Deviation(
                    f"{given}; expected up to {most} at 20 to 400 cm, nearest first, 0 after them"
                )


@check("V reads the battery, by kinds 0 to 5", "A, command V")
def battery(line: CheckedPort) -> None:
    pair, charge = r"v,-?\d{1,2},\d{1,4}", r"v,\d{3,4}" if _is_server(line) else r"v,\d{1,4}"
    for kind, pattern in enumerate((r"v,[5-9],\d{1,4}", pair, pair, charge, pair, r"v,\d{1,3}")):
        _expect(line, pattern, f"V,{kind}")
    _expect(line, r"\$", "V,6", "V")


@check("X sends 67 bytes: readings, speeds, positions and time, then LF CR", "A, command X", at_rest=True)
def binary(line: CheckedPort) -> None:
    line.order("D,l0,l0", "I,l1000,l-2", pause=STOPPING)
    line.send("X\n")
    reply: bytes = line.port.read(_BINARY_BYTES)
    motors = [int.from_bytes(reply[i : i + 4], "little", signed=True) for i in range(45, 61, 4)]
    if len(reply) != _BINARY_BYTES or reply[:1] + reply[65:] != b"x\n\r" or motors != [0, 0, 1000, -2]:
        raise Deviation(f"'X' was answered {reply!r}, with {motors}; expected x, 0, 0, 1000, -2, and LF CR")


@check("D drives the wheels at the requested speeds, which E reads", "A, commands D and E", FORWARD)
def driven_speed(line: CheckedPort) -> None:
    line.order("M")
    for speed in (10_000, -10_000):
        line.order(f"D,l{speed},l{speed}", pause=1.0)
        speeds, moved = line.numbers("E", 2), drive(line, f"D,l{speed},l{speed}", 0.3)
        pulses = abs(speed) * PULSES_PER_SPEED * 0.3
        expect_range("E", [n * speed // 10_000 for n in speeds], 9000, 11_000)
        expect_range("R", [n * speed // 10_000 for n in moved], int(0.8 * pulses), int(1.3 * pulses))


@check("D and L drive the left and the right wheel in this order", "A, commands D and L", SPIN)
def wheel_order(line: CheckedPort) -> None:
    for order, sign in (("D,l8000,l-8000", 1), ("L,l-400,l400", -1)):
        left, right = drive(line, order, 0.5)
        if min(left * sign, -right * sign) <= 0:
            raise Deviation(f"{order} moved the positions by {left}, {right}")
        drive(line, f"D,l{-8000 * sign},l{8000 * sign}", 0.5)


@check("F drives to positions, at the speed that J sets, and P without it", "A, commands F, J and P", FORWARD)
def targets(line: CheckedPort) -> None:
    line.order("M", "I,l0,l0", "J,d15000,d30")
    times = [drive_to(line, "F,l3000,l3000", 3000, _NEAR_PULSES)]
    line.order("J,d5000,d30")
    times += [
        drive_to(line, "F,l0,l0", 0, _NEAR_PULSES),
        drive_to(line, "P,l1000,l1000", 1000, _NEAR_PULSES),
        drive_to(line, "P,l0,l0", 0, _NEAR_PULSES),
    ]
    if not 1.2 < times[0] < 3.5 < times[1] < 7 or max(times[2:]) > 3:
        raise Deviation(f"F, F at a third of the speed, P and P took {times} s; expected 2, 4, 1 and 1 s")


@check("H sets the gains, of which a small Kp stays below the set point; M stops the motors", "A", FORWARD)
def gains(line: CheckedPort) -> None:
    line.order("H,d0,d10,d0,d0", "D,l20000,l20000", pause=0.5)
    speeds = line.numbers("E", 2)
    expect_range("E", speeds, 0, 10_000)
    line.order("M", "D,l8000,l8000", pause=0.4)
    expect_range("E", line.numbers("E", 2), 4000, 12_000)
    line.order("M")
    expect_standing(line, "after M in motion", _NEAR_PULSES)


@check("A drives without commands, also after a D, until A,2", "A, command A", ANYWHERE)
def vehicle(line: CheckedPort) -> None:
    line.order("A,0", "D,l0,l0", pause=0.8)
    speeds = line.numbers("E", 2)
    line.order("A,2")
    if not any(speeds):
        raise Deviation(f"after A,0 and D,l0,l0 E gave {speeds}; expected a robot that still drives")
    expect_standing(line, "after A,2", _NEAR_PULSES)


CHECKS = tuple(value for value in vars().values() if isinstance(value, Check))
KHEPERA_3_CHECKS = Catalogue(CHECKS, counters="R")
