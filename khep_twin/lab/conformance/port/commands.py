"""Checks of commands and tools that do not move the robot, and of the duration of replies."""

from khep_twin.lab.conformance.port.check import (
    REFUSED,
    SETTLE,
    CheckedPort,
    Deviation,
    Numbers,
    check,
    expect_in_time,
    expect_range,
    replies,
)
from khep_twin.units import COUNTS_LIMIT, N_SENSORS

_COUNTERS = "0,0", "1000,-1000", "2147483647,-2147483648", "0,0"

gains = replies("A and F accept the default gains", "A, commands A and F", "A,3800,800,100", "F,3000,20,4000")
profile = replies("J accepts the default profile, four numbers", "A, command J", "J,20,64,20,64")
counters = replies(
    "G sets the counters that H reads, all 32 bits of them",
    "A, commands G and H",
    *(step for numbers in _COUNTERS for step in (f"G,{numbers}", (f"h,{numbers}", "H"))),
    at_rest=True,
)
speeds = replies(
    "E reads two speeds, which are 0 for a robot at rest",
    "A, command E",
    *("D,0,0", 0.3, Numbers("E", 2, -1, 1)),
    at_rest=True,
)
setters = replies(
    "D and C and P are acknowledged", "A, commands C, D and P", "D,0,0", "P,0,0", "G,0,0", "C,0,0", "D,0,0"
)


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


proximity = replies(
    "N reads eight proximity values of 10 bits", "A, command N", Numbers("N", N_SENSORS, 0, COUNTS_LIMIT)
)
ambient = replies(
    "O reads eight ambient light values of 10 bits", "A, command O", Numbers("O", N_SENSORS, 0, COUNTS_LIMIT)
)
converter = replies(
    "I reads the six channels of the converter",
    "A, command I",
    *(Numbers(f"I,{channel}", 1, 0, COUNTS_LIMIT) for channel in range(6)),
)
leds = replies(
    "L switches both LEDs off and on, and toggles them",
    "A, command L",
    *("L,0,1", "L,0,2", "L,0,0", "L,1,1", "L,1,2", "L,1,0"),
)
missing_led = replies("an LED that does not exist is refused", "A, command L", (REFUSED, "L,5,0", "L,0,7"))
extension_bus = replies(
    "W writes and R reads a byte of the extension bus",
    "A, commands R and W",
    "W,0,63",
    Numbers("R,0", 1, 0, 255),
)
turrets = replies(
    "a turret answers under its number, an absent one is refused, none is silent",
    "A, command T",
    *((f"t,{turret},b.*|{REFUSED}", f"T,{turret},B") for turret in (1, 2, 4, 31)),
)


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
    line.expect("H", "h,0,0")
    line.expect("E", "e,0,0")
