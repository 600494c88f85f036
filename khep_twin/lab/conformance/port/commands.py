"""Checks of commands and tools that do not move the robot, and of the duration of replies."""

import re

from khep_twin.lab.conformance.port.check import (
    SETTLE,
    CheckedPort,
    Deviation,
    check,
    expect_in_time,
    expect_range,
    expect_refusals,
)
from khep_twin.units import COUNTS_LIMIT, N_SENSORS


@check("B reads the versions of BIOS and protocol", "A, command B")
def versions(line: CheckedPort) -> None:
    answer = line.ask("B")
    if not re.fullmatch(r"b,\d+\.\d+,\d+\.\d+", answer):
        raise Deviation(f"'B' was answered {answer!r}; expected a reply such as 'b,5.02,5.01'")


@check("A and F accept the default gains", "A, commands A and F")
def gains(line: CheckedPort) -> None:
    line.order("A,3800,800,100", "F,3000,20,4000")


@check("J accepts the default profile, four numbers", "A, command J")
def profile(line: CheckedPort) -> None:
    line.order("J,20,64,20,64")


@check("G sets the counters that H reads, all 32 bits of them", "A, commands G and H", at_rest=True)
def counters(line: CheckedPort) -> None:
    for left, right in ((0, 0), (1000, -1000), (2**31 - 1, -(2**31)), (0, 0)):
        line.order(f"G,{left},{right}")
        if (numbers := line.numbers("H", 2)) != [left, right]:
            raise Deviation(f"after G,{left},{right} H gave {numbers}")


@check("E reads two speeds, which are 0 for a robot at rest", "A, command E", at_rest=True)
def speeds(line: CheckedPort) -> None:
    line.order("D,0,0", pause=0.3)
    expect_range("E", line.numbers("E", 2), -1, 1)


@check("D and C and P are acknowledged", "A, commands C, D and P")
def setters(line: CheckedPort) -> None:
    line.order("D,0,0", "P,0,0", "G,0,0", "C,0,0", "D,0,0")


@check("K reads target, mode and error of both wheels", "A, command K", at_rest=True)
def status(line: CheckedPort) -> None:
    modes: list[int] = []
    for *setup, request in (("D,0,0",), ("G,0,0", "C,0,0"), ("P,0,0",)):
        line.order(*setup, request, pause=0.05)
        status = line.numbers("K", 6)
        expect_range("K", [status[0], status[3]], 0, 1)
        if status[1] != status[4]:
            raise Deviation(f"after {request} K gave two modes: {status}")
        modes.append(status[1])
    line.order("D,0,0")
    # Speed, position and PWM are 0, 1, 2; ROM versions before 5 have speed and position exchanged.
    if modes not in ([0, 1, 2], [1, 0, 2]):
        raise Deviation(f"in speed, position and PWM mode K gave {modes}; expected 0, 1, 2")


@check("N reads eight proximity values of 10 bits", "A, command N")
def proximity(line: CheckedPort) -> None:
    expect_range("N", line.numbers("N", N_SENSORS), 0, COUNTS_LIMIT)


@check("O reads eight ambient light values of 10 bits", "A, command O")
def ambient(line: CheckedPort) -> None:
    expect_range("O", line.numbers("O", N_SENSORS), 0, COUNTS_LIMIT)


@check("I reads the six channels of the converter", "A, command I")
def converter(line: CheckedPort) -> None:
    for channel in range(6):
        expect_range(f"I,{channel}", line.numbers(f"I,{channel}", 1), 0, COUNTS_LIMIT)


@check("L switches both LEDs off and on, and toggles them", "A, command L")
def leds(line: CheckedPort) -> None:
    for led in (0, 1):
        for action in (1, 2, 0):
            line.order(f"L,{led},{action}")


@check("an LED that does not exist is refused", "A, command L")
def missing_led(line: CheckedPort) -> None:
    expect_refusals(line, "L,5,0", "L,0,7")


@check("W writes and R reads a byte of the extension bus", "A, commands R and W")
def extension_bus(line: CheckedPort) -> None:
    line.order("W,0,63")
    expect_range("R,0", line.numbers("R,0", 1), 0, 255)


@check("a turret answers under its number, an absent one is refused, none is silent", "A, command T")
def turrets(line: CheckedPort) -> None:
    for turret in (1, 2, 4, 31):
        answer = line.ask(f"T,{turret},B")
        if not answer.startswith((f"t,{turret},b", "z,")):
            raise Deviation(f"'T,{turret},B' was answered {answer!r}; expected 't,{turret},b,…' or 'z,…'")


@check("every reply starts within 10 ms and lasts as long as its bytes", "3.2")
def reply_times(line: CheckedPort) -> None:
    for request in ("N", "B", "E", "H", "K", "O", "D,0,0", "G,0,0", "J,20,64,20,64", "L,0,0", "hello", "D"):
        expect_in_time(line, request)


@check("the tools answer in lines that end in CR LF", "3.2.1")
def tools(line: CheckedPort) -> None:
    for tool in ("help", "list", "net", "k-team", "memory", "process", "serial", "run", "sfill"):
        line.send(tool + "\n")
        output = line.read_until_quiet(SETTLE)
        if not output.endswith(b"\r\n") or output.startswith(b"Command not found"):
            raise Deviation(f"tool {tool!r} was answered {output[:60]!r}; expected lines that end in CR LF")
        if output.count(b"\n") != output.count(b"\r\n") or not output.isascii():
            raise Deviation(f"tool {tool!r} was answered {output[:60]!r}…; expected ASCII lines with CR LF")


@check(
    "restart shows the banner within half a second and resets everything", "3.2, tool restart", at_rest=True
)
def restart(line: CheckedPort) -> None:
    line.order("G,55,66", "J,5,5,5,5")
    line.send("restart\n")
    # The transmission of a longer banner takes more time.
    if banner := line.read_for(0.5):
        banner += line.read_until_quiet(SETTLE)
    if not banner.endswith(b"\r\n") or banner.count(b"\n") != banner.count(b"\r\n"):
        raise Deviation(f"'restart' was answered {banner!r}; expected lines that end in CR LF")
    if not any(b"ROM of minirobot KHEPERA" in text for text in banner.split(b"\r\n")):
        raise Deviation(f"'restart' was answered {banner!r}; expected a line with 'ROM of minirobot KHEPERA'")
    for letter in "HE":
        if (numbers := line.numbers(letter, 2)) != [0, 0]:
            raise Deviation(f"after a restart {letter} gave {numbers}; expected [0, 0]")
