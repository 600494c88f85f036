"""Checks of a Khepera IV's commands that do not move it."""

import re

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check, expect_range
from khep_twin.robots.khepera4.channels import (
    BINARY_BYTES,
    GROUND,
    PACKET_SIZE,
    RING,
    ULTRASONIC,
    ULTRASONIC_CODES,
)
from khep_twin.robots.khepera4.conformance.grammar import PUBLISHED, REVISION, expect_refused
from khep_twin.units import COUNTS_LIMIT

_TOO_NEAR_CM, _NO_ECHO_CM, _DISABLED_CM = ULTRASONIC_CODES
_N_INFRARED = len(RING) + len(GROUND)

_ROUND_S = 0.3
"""Time in which every ultrasonic sensor measures more than twice [s]."""
_BATTERY = (r"\d+", r"-?\d+", r"-?\d+", r"\d+", r"-?\d+\.\d", r"\d{1,3}", "[01]", r"\d{1,3}")
"""Values of V, by kind."""


@check("B reads the revision, a letter and a number", "6, command B")
def revision(line: CheckedPort) -> None:
    if not REVISION.fullmatch(answer := line.ask("B")):
        raise Deviation(f"'B' was answered {answer!r}; expected a reply such as 'b,B,0'")


@check("D, F, L, H, J, P, U and M are acknowledged", "6", at_rest=True)
def setters(line: CheckedPort) -> None:
    line.order("D,0,0", "I", "F,0,0", "L,0,0", "D,0,0")
    line.order("H,10,5,1", "J,3,0,20,1,400", "P,20", "U,31", "M")


@check("E reads two speeds, which are 0 for a robot at rest", "6, command E", at_rest=True)
def speeds(line: CheckedPort) -> None:
    line.order("D,0,0", pause=0.5)
    expect_range("E", line.numbers("E", 2), -3, 3)


@check("I sets the positions to 0 that R reads", "6, commands I and R", at_rest=True)
def positions(line: CheckedPort) -> None:
    line.order("D,0,0", "I")
    expect_range("R", line.numbers("R", 2), -20, 20)


@check("N reads twelve proximity values of 10 bits", "6, command N")
def proximity(line: CheckedPort) -> None:
    expect_range("N", line.numbers("N", _N_INFRARED), 0, COUNTS_LIMIT)


@check("O reads twelve ambient light values of 10 bits", "6, command O")
def ambient(line: CheckedPort) -> None:
    expect_range("O", line.numbers("O", _N_INFRARED), 0, COUNTS_LIMIT)


@check("G reads five distances, of those sensors that U enables", "6, commands G and U")
def ultrasonic(line: CheckedPort) -> None:
    for mask in (0, 4, 17, 31):
        line.order(f"U,{mask}", pause=_ROUND_S)
        for sensor, value in enumerate(line.numbers("G", len(ULTRASONIC))):
            enabled = mask >> sensor & 1
            is_valid = value in (_TOO_NEAR_CM, _NO_ECHO_CM) or 25 <= value <= 250
            if not (is_valid if enabled else value == _DISABLED_CM):
                expected = "25 to 250, 0 or 1000" if enabled else str(_DISABLED_CM)
                raise Deviation(f"after U,{mask} sensor {sensor} of G read {value}; expected {expected}")


@check("S reads ten turn rates of three axes", "6, command S", at_rest=True)
def gyroscope(line: CheckedPort) -> None:
    expect_range("S", line.numbers("S", 3 * PACKET_SIZE), -1000, 1000)


@check("T reads ten accelerations of three axes, the last minus 1 g", "6, command T", at_rest=True)
def accelerometer(line: CheckedPort) -> None:
    line.sleep(0.2)
    values = line.numbers("T", 3 * PACKET_SIZE)
    expect_range("T", values[:20], -6000, 6000)
    expect_range("T", values[20:], -20_000, -12_000)


@check("V reads eight values of the battery, in the manual's units", "6, command V")
def battery(line: CheckedPort) -> None:
    for kind, pattern in enumerate(_BATTERY):
        answer = line.ask(f"V,{kind}")
        if not re.fullmatch(f"v,{pattern}", answer):
            raise Deviation(f"'V,{kind}' was answered {answer!r}; expected 'v,' and {pattern}")
    expect_range("V,5", line.numbers("V,5", 1), 0, 100)


@check("V,0 reads the voltage of two cells", "6, command V")
def voltage(line: CheckedPort) -> None:
    expect_range("V,0", line.numbers("V,0", 1), 5900, 8800)


@check("V refuses other kinds, and more than one", PUBLISHED)
def other_kinds(line: CheckedPort) -> None:
    expect_refused(line, "V,8", "V,-1", "V,1,2")


@check("K accepts nine colours of any value, and refuses another number of them", "6, command K")
def leds(line: CheckedPort) -> None:
    line.order("K,64,-1,999,0,0,0,0,0,0", "K,0,0,0,0,0,0,0,0,0,", "K,,0,0,0,0,0,0,0,0,0")
    expect_refused(line, "K,1,2,3", "K,1,2,3,4,5,6,7,8", "K,1,2,3,4,5,6,7,8,9,10")


@check("A,2 is acknowledged at any time, other kinds are refused", "6, command A", at_rest=True)
def refused_vehicles(line: CheckedPort) -> None:
    line.order("A,2", "A,2")
    expect_refused(line, "A,3", "A,-1", "A,0,0")


@check("X sends 128 bytes: readings from their second byte on, speeds and positions", PUBLISHED, at_rest=True)
def binary(line: CheckedPort) -> None:
    line.order("D,0,0", "I", pause=0.3)
    line.send("X\n")
    reply: bytes = line.port.read(BINARY_BYTES)
    if len(reply) != BINARY_BYTES or reply[:1] != b"x" or reply[65:67] != b"\n\r":
        raise Deviation(f"'X' was answered {reply!r}; expected 128 bytes, x first, LF CR at 65 and 66")
    upper_bytes = [*reply[1:24:2], *reply[25:48:2]]
    if max(upper_bytes) > 3:
        raise Deviation(f"'X' gave {upper_bytes} as upper bytes of 10 bits; expected 0 to 3")
    for offset, name, tolerance in ((49, "speeds", 3), (57, "positions", 20)):
        for start in (offset, offset + 4):
            value = int.from_bytes(reply[start : start + 4], "little", signed=True)
            if abs(value) > tolerance:
                raise Deviation(f"'X' gave {value} among the {name} of a robot at rest; expected 0")


@check("Z resets the microcontroller, and its positions to 0", "6, command Z", at_rest=True)
def reset(line: CheckedPort) -> None:
    line.order("P,20", "U,0", "Z", pause=_ROUND_S)
    expect_range("R", line.numbers("R", 2), -3, 3)
    if _DISABLED_CM in (distances := line.numbers("G", len(ULTRASONIC))):
        raise Deviation(f"after U,0 and Z G gave {distances}; expected all sensors enabled")
    line.order("M")
