"""Checks of a Khepera III at a port, with its firmware or kh3server; section "server" is the latter."""

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, Numbers, check, expect_range, replies
from khep_twin.lab.conformance.port.letters import LetterChecks, is_server
from khep_twin.robots.khepera3.model import COUNTS_LIMIT
from khep_twin.robots.khepera3.registers import PULSES_PER_SPEED, ULTRASONIC

_ROUND_S = 0.6
"""Time in which every ultrasonic sensor measures more than twice [s]."""

_PAIR, _CHARGE = r"v,-?\d{1,2},\d{1,4}", r"v,\d{1,4}"
_BATTERY = r"v,[5-9],\d{1,4}", _PAIR, _PAIR, _CHARGE, _PAIR, r"v,\d{1,3}"
"""Replies to V, by kind."""


@check("all replies end alike, in LF CR or CR LF", "A")
def _ends(line: CheckedPort) -> None:
    ends: set[bytes] = set()
    for request in ("B", "E", "N", "Q", "V,0"):
        line.send(request + "\n")
        ends.add(line.framing.read(line.port, line.time)[-2:])
    if ends not in ({b"\n\r"}, {b"\r\n"}):
        raise Deviation(f"replies ended in {ends}; expected LF CR or CR LF")


@check("numbers of more than 8 bits need a prefix; decimals and further ones are ignored", "A", at_rest=True)
def _prefixes(line: CheckedPort) -> None:
    line.order("D,l0,l0", "I,l12.75,l-3.2")
    line.expect("R", "r,12,-3")
    line.order("I,l500,l-600" + ",0" * 60)
    line.expect("R", "r,500,-600")
    if is_server(line):  # blanks the first character
        line.order("I,500,-600")
        line.expect("R", "r,0,600")
        return
    for request in ("I,500,-600", "I,d40000,d70000", "I,l5", "I"):
        line.expect(request, "$")
    line.expect("R", "r,500,-600")


@check("N and O read eleven values of 12 bits", "A, commands N and O")
def _infrared(line: CheckedPort) -> None:
    values = line.numbers("N", 12)[:11]
    # kh3server sends negative noise as unsigned numbers.
    expect_range("N", [value - 0x10000 if value & 0x8000 else value for value in values], -50, COUNTS_LIMIT)
    expect_range("O", line.numbers("O", 12)[:11], 0, COUNTS_LIMIT)


@check("G reads up to five echoes of an active sensor, none of another one", "A, commands C and G")
def _ultrasonic(line: CheckedPort) -> None:
    for mask, limit in ((0, 3), (31, 1), (6, 5), (31, 3), (4, 3)):
        line.order(f"C,0,d{mask}", f"C,1,d{limit}", pause=_ROUND_S)
        for sensor in range(len(ULTRASONIC)):
            count, *numbers, _ = line.numbers(f"G,{sensor + 1}", 17)
            distances, largest = numbers[::3], limit if mask >> sensor & 1 else 0
            is_sound = count <= largest and all(20 <= cm <= 400 for cm in distances[:count])
            if not is_sound or any(numbers[3 * count :]) or distances[:count] != sorted(distances[:count]):
                reply = f"with C,0,d{mask} and C,1,d{limit} G,{sensor + 1} gave {count} echoes, {numbers}"
                raise Deviation(
                    f"{reply}; expected up to {largest} at 20 to 400 cm, nearest first, 0 after them"
                )


KHEPERA_3_CHECKS = LetterChecks(
    section="A",
    version=r"b,\d+,\d+",
    origin="I,l-70000,l1000",
    binary=(67, 45),
    speed=10_000,
    duty=400,
    pulse_rate=PULSES_PER_SPEED,
    weak_gains="H,d0,d10,d0,d0",
    moves=(
        (("M", "I,l0,l0", "J,d15000,d30"), "F", 3000, 1.2, 3.5),
        (("J,d5000,d30",), "F", 0, 3.5, 7),
        ((), "P", 1000, 0, 3),
        ((), "P", 0, 0, 3),
    ),
    near=60,
    prefix="l",
    positions=(-70_000, 1000),
).catalogue(
    _ends,
    replies(
        "an unknown command is answered with $", "server", ("$", *"Q S T W Y b hello 0 ? $ V,6 V".split())
    ),
    _prefixes,
    replies(
        "commands that set something are acknowledged",
        "A",
        *"D,l0,l0 I,l0,l0 F,l0,l0 P,l0,l0 L,l0,l0 C,0,d4 C,1,d3 K,0,1 K,0,2 K,1,0".split(),
        *"H,d1,d600,d30,d20 H,d0,d620,d10,d3 J,d15000,d30 A,2 M D,l0,l0 Z".split(),
        at_rest=True,
    ),
    _infrared,
    replies(
        "the last value of N is the time since Z in ms",
        "A, command Z",
        *(0.4, "Z", 1.0, Numbers("N", 12, 850, 1150, slice(11, None))),
    ),
    _ultrasonic,
    replies(
        "V reads the battery, by kinds 0 to 5",
        "A, command V",
        *((pattern, f"V,{kind}") for kind, pattern in enumerate(_BATTERY)),
    ),
)
"""All checks."""
