"""Checks of a Khepera IV at a port, on which kh4server runs; section "server" is the published program."""

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, Numbers, check, replies
from khep_twin.lab.conformance.port.letters import LetterChecks, single_bytes
from khep_twin.robots.khepera4.dspic import N_INFRARED, N_ULTRASONIC
from khep_twin.robots.khepera4.registers import BINARY_BYTES, PACKET_SIZE, ULTRASONIC_CODES
from khep_twin.units import COUNTS_LIMIT

_TOO_NEAR_CM, _NO_ECHO_CM, _DISABLED_CM = ULTRASONIC_CODES
_ROUND_S = 0.3
"""Time in which every ultrasonic sensor measures more than twice [s]."""

_BATTERY = (r"\d+", r"-?\d+", r"-?\d+", r"\d+", r"-?\d+\.\d", r"\d{1,3}", "[01]", r"\d{1,3}")
"""Values of V, by kind."""

_REFUSED = (
    *("C", "C,1,1", "Q", "W", "Y", "b", "n", "hello", " ", " B", "0", "?", "$", ",", "A,3", "A,-1", "A,0,0"),
    *("V,8", "V,-1", "V,1,2", "K,1,2,3", "K,1,2,3,4,5,6,7,8", "K,1,2,3,4,5,6,7,8,9,10"),
    bytes(range(ord(" "), 127)).decode(),
)


@check("G reads five distances, of those sensors that U enables", "6, commands G and U")
def _ultrasonic(line: CheckedPort) -> None:
    for mask in (0, 4, 17, 31):
        line.order(f"U,{mask}", pause=_ROUND_S)
        for sensor, value in enumerate(line.numbers("G", N_ULTRASONIC)):
            enabled = mask >> sensor & 1
            is_valid = value in (_TOO_NEAR_CM, _NO_ECHO_CM) or 25 <= value <= 250
            if not (is_valid if enabled else value == _DISABLED_CM):
                expected = "25 to 250, 0 or 1000" if enabled else str(_DISABLED_CM)
                raise Deviation(f"after U,{mask} sensor {sensor} of G read {value}; expected {expected}")


KHEPERA_4_CHECKS = LetterChecks(
    section="6",
    version=r"b,[A-P],(0|[1-9]\d?)",
    origin="I",
    binary=(BINARY_BYTES, 49),
    speed=200,
    duty=600,
    pulse_rate=100,
    weak_gains="H,10,0,0",
    moves=(
        (("M", "I"), "F", 30_000, 1.3, 4),
        ((), "F", 0, 1.3, 4),
        (("J,3,0,20,1,100",), "F", 20_000, 1.9, 5),
        (("M",), "F", 0, 0.9, 4),
    ),
    near=200,
    small_bytes=(*range(1, 24, 2), *range(25, 48, 2)),
    stops=("M", "Z"),
    vehicles=(("A,0", "A,2", "a"), ("A,1", "A,3", "$")),
).catalogue(
    single_bytes("6", "P,20"),
    replies("unknown commands, and other numbers of values, are answered with $", "6", ("$", *_REFUSED)),
    replies(
        "numbers are parsed as in C, and empty ones are skipped",
        "server",
        (r"v,\d{1,3}", "V, 7", "V,+07", "V,7x,", "V,,7", "Vx7", "V,65541"),
    ),
    replies(
        "only the first 82 bytes of a long line count, and it gets one reply",
        "server",
        "K," + "0,,,,,,,," * 8 + ",,,,,,,0,1,1,1",
    ),
    replies(
        "H, J, P, U, M, K with colours of any value, and A,2 are acknowledged",
        "6",
        *("H,10,5,1", "J,3,0,20,1,400", "P,20", "U,31", "M", "A,2", "A,2"),
        *("K,64,-1,999,0,0,0,0,0,0", "K,0,0,0,0,0,0,0,0,0,", "K,,0,0,0,0,0,0,0,0,0"),
        at_rest=True,
    ),
    replies("N reads proximity of 10 bits", "6, command N", Numbers("N", N_INFRARED, 0, COUNTS_LIMIT)),
    replies("O reads ambient light of 10 bits", "6, command O", Numbers("O", N_INFRARED, 0, COUNTS_LIMIT)),
    _ultrasonic,
    replies("S reads turn rates", "6, command S", Numbers("S", 3 * PACKET_SIZE, -1000, 1000), at_rest=True),
    replies(
        "T reads accelerations, the last ones minus 1 g",
        "6, command T",
        *(0.2, Numbers("T", 3 * PACKET_SIZE, -6000, 6000, slice(2 * PACKET_SIZE))),
        Numbers("T", 3 * PACKET_SIZE, -20_000, -12_000, slice(2 * PACKET_SIZE, None)),
        at_rest=True,
    ),
    replies(
        "V reads eight values of the battery, of two cells, in the manual's units",
        "6, command V",
        *((f"v,{pattern}", f"V,{kind}") for kind, pattern in enumerate(_BATTERY)),
        *(Numbers("V,0", 1, 5900, 8800), Numbers("V,5", 1, 0, 100)),
    ),
    replies(
        "Z resets the microcontroller, and its positions to 0",
        "6, command Z",
        *("P,20", "U,0", "Z", _ROUND_S, Numbers("R", 2, -3, 3), (r"g(,(?!2000)\d+){5}", "G"), "M"),
        at_rest=True,
    ),
)
"""All checks."""
