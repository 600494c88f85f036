"""Checks of `conformance` that leave the robot where it is, in the order in which they run."""

import re
from collections.abc import Callable

from khep_twin.lab.conformance.conformance import Check, CheckedPort, Deviation
from khep_twin.lab.conformance.expectations import expect_in_time, expect_range, expect_refusals
from khep_twin.units import COUNTS_LIMIT, N_SENSORS

ALL: list[Check] = []
"""All checks; `check` adds to them."""

SETTLE = 0.2
"""Silence that ends a banner [s]."""


def check(
    name: str, section: str, moves: str = "", turret: int | None = None
) -> Callable[[Callable[[CheckedPort], None]], None]:
    """Return a decorator that adds a function to the checks."""

    def add(body: Callable[[CheckedPort], None]) -> None:
        ALL.append(Check(name, section, moves, body, turret))

    return add


# Grammar -------------------------------------------------------------------------------------------------


@check("a command may end in LF, CR or CR LF, and CR LF is one ending", "3.2, A")
def _endings(line: CheckedPort) -> None:
    for end in ("\n", "\r", "\r\n"):
        answer = line.ask("B", end)
        if not answer.startswith("b,"):
            raise Deviation(f"{'B' + end!r} was answered {answer!r}")
        line.silent(f"after the reply to {'B' + end!r}")


@check("an empty line gets no reply", "3.2")
def _empty_lines(line: CheckedPort) -> None:
    line.send("\n\r\n\r")
    line.silent("after empty lines")


@check("bytes sent one at a time make up a line", "3.2")
def _single_bytes(line: CheckedPort) -> None:
    for byte in "G,12,-34\n":
        line.send(byte)
        line.sleep(0.002)
    if (answer := line.reply("G,12,-34")) != "g":
        raise Deviation(f"'G,12,-34' was answered {answer!r}; expected 'g'")


@check("a burst of seven commands is answered in order", "3.2")
def _burst(line: CheckedPort) -> None:
    line.send("E\nH\nN\nO\nK\nB\nE\n")
    heads = "".join(line.reply("a command of a burst").split(",")[0] for _ in range(7))
    if heads != "ehnokbe":
        raise Deviation(f"E H N O K B E was answered in the order {' '.join(heads)}")


@check("an unknown command is answered with Command not found", "3.2")
def _unknown_words(line: CheckedPort) -> None:
    for word in ("hello", "d,5,5", "n", "b", "XY", " ", "  ", "\x01", "?", "x" * 65, *"MQSUVXYZ"):
        line.expect(word, "Command not found")


@check("missing, surplus or wrong parameters are a protocol error", "A")
def _wrong_parameters(line: CheckedPort) -> None:
    requests = "D D,1 D,1,2,3 D,a,b D,, C,1 G,1 A,1,2 F,1,2 P,1 J,20,64 J,1,2,3 I L,0 R W,1 N,1 T"
    for request in requests.split():
        line.expect(request, "z,Protocol error")


@check("numbers may carry a sign and leading zeros", "A")
def _signs(line: CheckedPort) -> None:
    line.order("G,+5,-005")
    if (numbers := line.numbers("H", 2)) != [5, -5]:
        raise Deviation(f"G,+5,-005 set the counters to {numbers}")


@check("an over-long line gets one reply and has no other effect", "3.2")
def _long_line(line: CheckedPort) -> None:
    line.send("D," + "1" * 600 + "\n")
    line.reply("a line of 602 bytes")
    line.silent("after the answer to an over-long line")
    line.order("G,3,4")


@check("commands work again after rubbish", "3.2")
def _rubbish(line: CheckedPort) -> None:
    line.send(bytes(byte for byte in range(256) if byte not in b"\r\n").decode("latin-1") + "\n")
    line.reply("binary rubbish")
    line.order("G,1,2")
    if (numbers := line.numbers("H", 2)) != [1, 2]:
        raise Deviation(f"after rubbish H gave {numbers}; expected [1, 2]")


# Commands ------------------------------------------------------------------------------------------------


@check("B reads the versions of BIOS and protocol", "A, command B")
def _versions(line: CheckedPort) -> None:
    answer = line.ask("B")
    if not re.fullmatch(r"b,\d+\.\d+,\d+\.\d+", answer):
        raise Deviation(f"'B' was answered {answer!r}; expected a reply such as 'b,5.02,5.01'")


@check("A and F accept the default gains", "A, commands A and F")
def _gains(line: CheckedPort) -> None:
    line.order("A,3800,800,100", "F,3000,20,4000")


@check("J accepts the default profile, four numbers", "A, command J")
def _profile(line: CheckedPort) -> None:
    line.order("J,20,64,20,64")


@check("G sets the counters that H reads, all 32 bits of them", "A, commands G and H")
def _counters(line: CheckedPort) -> None:
    for left, right in ((0, 0), (1000, -1000), (2**31 - 1, -(2**31)), (0, 0)):
        line.order(f"G,{left},{right}")
        if (numbers := line.numbers("H", 2)) != [left, right]:
            raise Deviation(f"after G,{left},{right} H gave {numbers}")


@check("E reads two speeds, which are 0 for a robot at rest", "A, command E")
def _speeds(line: CheckedPort) -> None:
    line.order("D,0,0", pause=0.3)
    expect_range("E", line.numbers("E", 2), -1, 1)


@check("D and C and P are acknowledged", "A, commands C, D and P")
def _setters(line: CheckedPort) -> None:
    line.order("D,0,0", "P,0,0", "G,0,0", "C,0,0", "D,0,0")


@check("K reads target, mode and error of both wheels", "A, command K")
def _status(line: CheckedPort) -> None:
    modes: list[int] = []
    for *before, request in (("D,0,0",), ("G,0,0", "C,0,0"), ("P,0,0",)):
        line.order(*before, request, pause=0.05)
        status = line.numbers("K", 6)
        expect_range("K", [status[0], status[3]], 0, 1)
        if status[1] != status[4]:
            raise Deviation(f"after {request} K gave two modes: {status}")
        modes.append(status[1])
    line.order("D,0,0")
    # Speed, position, PWM are 0, 1, 2; versions of the ROM before 5 have speed and position exchanged.
    if modes not in ([0, 1, 2], [1, 0, 2]):
        raise Deviation(f"in speed, position and PWM mode K gave {modes}; expected 0, 1, 2")


@check("N reads eight proximity values of 10 bits", "A, command N")
def _proximity(line: CheckedPort) -> None:
    expect_range("N", line.numbers("N", N_SENSORS), 0, COUNTS_LIMIT)


@check("O reads eight ambient light values of 10 bits", "A, command O")
def _ambient(line: CheckedPort) -> None:
    expect_range("O", line.numbers("O", N_SENSORS), 0, COUNTS_LIMIT)


@check("I reads the six channels of the converter", "A, command I")
def _converter(line: CheckedPort) -> None:
    for channel in range(6):
        expect_range(f"I,{channel}", line.numbers(f"I,{channel}", 1), 0, COUNTS_LIMIT)


@check("L switches both LEDs off and on, and toggles them", "A, command L")
def _leds(line: CheckedPort) -> None:
    for led in (0, 1):
        for action in (1, 2, 0):
            line.order(f"L,{led},{action}")


@check("an LED that does not exist is refused", "A, command L")
def _no_led(line: CheckedPort) -> None:
    expect_refusals(line, "L,5,0", "L,0,7")


@check("W writes and R reads a byte of the extension bus", "A, commands R and W")
def _bus(line: CheckedPort) -> None:
    line.order("W,0,63")
    expect_range("R,0", line.numbers("R,0", 1), 0, 255)


@check("a turret answers under its number, an absent one is refused, none is silent", "A, command T")
def _turrets(line: CheckedPort) -> None:
    for turret in (1, 2, 4, 31):
        answer = line.ask(f"T,{turret},B")
        if not answer.startswith((f"t,{turret},b", "z,")):
            raise Deviation(f"'T,{turret},B' was answered {answer!r}; expected 't,{turret},b,…' or 'z,…'")


# Time ----------------------------------------------------------------------------------------------------


@check("every reply begins within 10 ms and takes its bytes' time on the line", "3.2")
def _pace(line: CheckedPort) -> None:
    for request in ("N", "B", "E", "H", "K", "O", "D,0,0", "G,0,0", "J,20,64,20,64", "L,0,0", "hello", "D"):
        expect_in_time(line, request)


# Tools -----------------------------------------------------------------------------------------------------


@check("the tools answer in lines", "3.2.1")
def _tools(line: CheckedPort) -> None:
    for tool in ("help", "list", "net", "k-team", "memory", "process", "serial", "run", "sfill"):
        line.send(tool + "\n")
        told = line.read_until_quiet(SETTLE)
        if not told.endswith(b"\r\n") or told.startswith(b"Command not found"):
            raise Deviation(f"the tool {tool!r} was answered {told[:60]!r}; expected lines that end in CR LF")
        if told.count(b"\n") != told.count(b"\r\n") or not told.isascii():
            raise Deviation(
                f"the tool {tool!r} was answered {told[:60]!r}…; expected plain lines, CR LF each"
            )


# Reset ---------------------------------------------------------------------------------------------------


@check("restart shows the banner within half a second and resets everything", "3.2, tool restart")
def _restart(line: CheckedPort) -> None:
    line.order("G,55,66", "J,5,5,5,5")
    line.send("restart\n")
    # A longer banner takes its own time on the line.
    if banner := line.read_for(0.5):
        banner += line.read_until_quiet(SETTLE)
    if not banner.endswith(b"\r\n") or banner.count(b"\n") != banner.count(b"\r\n"):
        raise Deviation(f"'restart' was answered {banner!r}; expected lines that end in CR LF")
    if not any(b"ROM of minirobot KHEPERA" in text for text in banner.split(b"\r\n")):
        raise Deviation(f"'restart' was answered {banner!r}; expected a line with 'ROM of minirobot KHEPERA'")
    if (numbers := line.numbers("H", 2)) != [0, 0]:
        raise Deviation(f"after a restart H gave {numbers}; expected [0, 0]")
    if (numbers := line.numbers("E", 2)) != [0, 0]:
        raise Deviation(f"after a restart E gave {numbers}; expected [0, 0]")
