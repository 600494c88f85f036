"""Checks of a K213, a turret with a linear camera of 64 pixels.

They check only properties that hosts need. They do not check that M has 16 greys, nor the exact reply to a
wrong parameter, for which there is no source.
"""

from khep_twin.lab.conformance.port.check import (
    REFUSED,
    CheckedPort,
    Deviation,
    check,
    expect_in_time,
    expect_range,
)
from khep_twin.units import K213_NUMBER, K213_PERIODS_MS, K213_PIXELS

TURN = "turns on the spot by 6 degrees and back"

SECTION = "K213"

_SLOWEST = len(K213_PERIODS_MS) - 1
_SCAN = 1.1
"""Longest time until an image with automatic exposure is ready [s] (assumed: scans of up to a second)."""
_TURN_PULSES = 34
"""Pulses of each wheel for a turn by 6 degrees, 10 pixels, on the spot."""
_CONTRAST = 60
"""Smallest difference of brightest and darkest pixel by which a turn is detected [greys] (assumed)."""


def _values(line: CheckedPort, message: str, count: int, limit: int = 255) -> list[int]:
    """Return the numbers of a reply; raise a `Deviation` unless there are `count` from 0 to a limit."""
    values = line.numbers(f"T,{K213_NUMBER},{message}", count)
    expect_range(f"T,{K213_NUMBER},{message}", values, 0, limit)
    return values


def _set_period(line: CheckedPort, period: int) -> None:
    line.expect(f"T,{K213_NUMBER},U,{period}", f"t,{K213_NUMBER},u")


def _image(line: CheckedPort) -> list[int]:
    return _values(line, "N", K213_PIXELS)


@check("a K213 reports its version as two integers", SECTION, turret=K213_NUMBER)
def versions(line: CheckedPort) -> None:
    _values(line, "B", 2)


@check("a K213 has 64 greys of 8 bits, and 32 values in M", SECTION, turret=K213_NUMBER)
def greys(line: CheckedPort) -> None:
    _image(line)
    _values(line, "M", K213_PIXELS // 2)


@check("the light sensor of a K213 reads two bytes", SECTION, turret=K213_NUMBER)
def light(line: CheckedPort) -> None:
    _values(line, "L", 2)


@check("S, T, Q, R of a K213 read parts of its image, O and P its extremes", SECTION, turret=K213_NUMBER)
def parts_of_the_image(line: CheckedPort) -> None:
    # The image does not change within the longest period.
    _set_period(line, _SLOWEST)
    image = _image(line)
    for message, pixels in (
        ("S", image[::2]),
        ("T", image[::4]),
        ("Q,0", image[:8]),
        ("Q,29", image[29:37]),
        ("R,0", image[:16]),
        ("R,48", image[48:]),
    ):
        if (values := _values(line, message, len(pixels))) != pixels:
            raise Deviation(f"'T,{K213_NUMBER},{message}' gave {values}; expected {pixels} of the image")
    for letter, limit in (("O", max(image)), ("P", min(image))):
        (index,) = _values(line, letter, 1, K213_PIXELS - 1)
        if image[index] != limit:
            text = f"'T,{K213_NUMBER},{letter}' gave {index}, a pixel of {image[index]}"
            raise Deviation(f"{text}; expected one of {limit}")
    _set_period(line, 0)


@check("a K213 accepts every period and refuses others", SECTION, turret=K213_NUMBER)
def periods(line: CheckedPort) -> None:
    for period in (*range(1, len(K213_PERIODS_MS)), 0):
        _set_period(line, period)
    _expect_refused(line, f"U,{len(K213_PERIODS_MS)}", "U,-1", "U")


@check("a K213 refuses missing pixels, wrong parameters and unknown letters", SECTION, turret=K213_NUMBER)
def refusals(line: CheckedPort) -> None:
    _expect_refused(line, f"Q,{K213_PIXELS}", "Q,-1", "Q", f"R,{K213_PIXELS}", "R", "N,1", "L,x", "X")


def _expect_refused(line: CheckedPort, *messages: str) -> None:
    for message in messages:
        line.expect(f"T,{K213_NUMBER},{message}", REFUSED)


@check(
    "a long reply of a K213 starts within 10 ms and lasts as long as its bytes", SECTION, turret=K213_NUMBER
)
def reply_times(line: CheckedPort) -> None:
    expect_in_time(line, f"T,{K213_NUMBER},N")


@check("the image of a K213 moves right as it turns left, at its period", SECTION, TURN, turret=K213_NUMBER)
def turning(line: CheckedPort) -> None:
    _set_period(line, 0)
    line.sleep(_SCAN)
    first = _image(line)
    _turn(line, _TURN_PULSES)
    turned = _image(line)
    _set_period(line, _SLOWEST)
    frozen = _image(line)
    _turn(line, 0)
    if (last := _image(line)) != frozen:
        raise Deviation(f"with U,{_SLOWEST} the image changed from {frozen} to {last} within 5 s")
    _set_period(line, 0)
    line.order("D,0,0")
    if max(first) - min(first) < _CONTRAST or max(turned) - min(turned) < _CONTRAST:
        return  # too little contrast to detect a turn
    shift = min(range(-24, 25), key=lambda shift: (_difference(first, turned, shift), abs(shift)))
    if not 4 <= shift <= 18:
        raise Deviation(
            f"a turn to the left by 6 degrees moved the image by {shift} pixels; expected about 10"
        )


def _turn(line: CheckedPort, pulses: int) -> None:
    """Turn on the spot to counters of -pulses and pulses, and wait for an image."""
    if pulses:
        line.order("D,0,0", "G,0,0")
    line.order(f"C,{-pulses},{pulses}", pause=0.8)
    line.sleep(_SCAN)


def _difference(image: list[int], shifted: list[int], shift: int) -> float:
    """Return the mean difference of two images, the second shifted to the right by some pixels."""
    pairs = [
        (image[pixel - shift], shifted[pixel])
        for pixel in range(K213_PIXELS)
        if 0 <= pixel - shift < K213_PIXELS
    ]
    return sum(abs(one - other) for one, other in pairs) / len(pairs)
