"""A fuzz target: arbitrary bytes from a host of RFC 2217, in pieces of any size.

    python -m checks fuzz-rfc2217 -runs=1000000      with atheris (libFuzzer)

The first byte chooses the size of the pieces, and whether the others are the host's bytes or a recipe for
them: negotiations with any command and any length of value, options, escapes, data. `check` has the
conditions.
"""

from pathlib import Path

from checks.fuzz.libfuzzer import fuzz

IAC, SE, SB, WILL, DONT, OPTION = 0xFF, 0xF0, 0xFA, 0xFB, 0xFE, 0x2C
BEGIN = b"\xff\xfa\x2c"
END = b"\xff\xf0"

WELL_FORMED = [
    "00",
    "00 41",
    "05 0d",
    "05 11",
    "01 00 00 25 80",
    "01 00 00 00 00",
    "02 08",
    "03 01",
    "04 02",
    "05 08",
    "06",
    "07",
    "0b ff ff",
]
"""Content between `BEGIN` and `END`."""

ODD = ["01 01", "01 ff ff ff ff ff ff ff ff", "02", "02 4d", "03 4d", "04 09", "05", "0a", "0c"]
"""Values too short or out of range."""

BAUDS = 9600, 115_200
"""Baud rates of the robots' lines: of a Khepera, and of a Khepera IV."""

RECIPE = 0x80
"""Bit of the first byte: the others are a recipe."""

VALUE_SIZES = {1: 4, 2: 1, 3: 1, 4: 1, 10: 1, 11: 1}
"""Commands that are only answered with a whole value; pyserial ignores a short value of the others."""

ANSWER_SIZES = {101: 4, 102: 1, 103: 1, 104: 1, 105: 1, 106: 1, 107: 1, 110: 1, 111: 1, 112: 1}
"""Answers of the robot's end, and the lengths of their values; 100, a signature, has any."""


def check(data: bytes) -> None:
    """Negotiate with one host and check the result.

    Raises:
        AssertionError: The bytes for the robot are not the host's without the negotiation, a fault is missed
            or reported without one, an answer is none of RFC 2217, settings are out of range, memory is not
            bounded, or the pieces make a difference.
    """
    from khep_twin.ports.negotiation import HIGHEST_BAUD, LOWEST_BAUD, MAX_CONTENT_BYTES

    choice = data[0] if data else 0
    baud = BAUDS[len(data) % len(BAUDS)]
    stream = cooked(data[1:]) if choice & RECIPE else data[1:]
    size = choice % RECIPE + 1
    received, answers, settings, fault = outcome([stream], baud)
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert (received, answers, settings, fault) == outcome(pieces, baud)
    expected, is_faulty = without_negotiation(stream, MAX_CONTENT_BYTES)
    expected = expected.replace(b"\r\0", b"\r")  # one line end, as in Telnet
    assert received == expected, (received, expected)
    assert bool(fault) == is_faulty, fault
    assert len(fault) < 300, fault
    assert LOWEST_BAUD <= settings[0] <= HIGHEST_BAUD, settings
    assert settings[1] in (1, 2), settings
    assert len(answers) <= 100 + 5 * len(stream), answers
    check_answers(answers)


def outcome(pieces: list[bytes], baud: int) -> tuple[bytes, bytes, tuple[int, int], str]:
    """Return the results of one connection: bytes for the robot, answers, settings, a fault."""
    from khep_twin.ports.negotiation import Negotiator

    answers = bytearray()
    negotiator = Negotiator(baud, answers.extend)
    received = b"".join(map(negotiator.decode, pieces))
    settings = negotiator.settings()
    assert without_negotiation(negotiator.encode(received), 0) == (received, False)
    return received, bytes(answers), (settings.baud, settings.stop_bits), negotiator.fault


def without_negotiation(stream: bytes, longest: int) -> tuple[bytes, bool]:
    """Return the data in a stream up to its first fault, and whether it has one."""
    data, inside, rest = bytearray(), None, list(reversed(stream))
    while rest:
        value = rest.pop()
        if value == IAC:
            if not rest:
                break
            value = rest.pop()
            if value == SB:
                inside = bytearray()
                continue
            if value == SE:
                if inside is None or is_short(inside):
                    return bytes(data), True
                inside = None
                continue
            if WILL <= value <= DONT and not rest:
                break
            if WILL <= value <= DONT:
                rest.pop()
            if value != IAC:
                continue
        (data if inside is None else inside).append(value)
        if inside is not None and len(inside) > longest:
            return bytes(data), True
    return bytes(data), False


def is_short(inside: bytearray) -> bool:
    """Return whether a negotiation of RFC 2217 lacks its value."""
    command = inside[1] if len(inside) > 1 and inside[0] == OPTION else 0
    return len(inside) - 2 < VALUE_SIZES.get(command, -2)


def check_answers(answers: bytes) -> None:
    """Check that all of it is options and whole answers of RFC 2217."""
    at = 0
    while at < len(answers):
        assert answers[at] == IAC, answers[at:]
        if WILL <= answers[at + 1] <= DONT:
            assert at + 3 <= len(answers), answers[at:]
            at += 3
            continue
        assert answers[at : at + 3] == BEGIN, answers[at:]
        end = answers.index(END, at)
        while answers[at:end].count(IAC) % 2 == 0:  # an escape and its byte
            end = answers.index(END, end + 1)
        value = answers[at + 4 : end].replace(b"\xff\xff", b"\xff")
        kind = answers[at + 3]
        assert kind == 100 or len(value) == ANSWER_SIZES[kind], answers[at:end]
        at = end + len(END)


def cooked(recipe: bytes) -> bytes:
    """Return the host's bytes of a recipe, whose steps are a kind and bytes of detail."""
    stream, rest = b"", iter(recipe)
    for step in rest:
        code, size = next(rest, 0), next(rest, 0)
        value = bytes(next(rest, 0) for _ in range(size % 7)).replace(b"\xff", b"\xff\xff")
        match step % 8:
            case 0 | 1 | 2:
                stream += BEGIN + bytes([code % 16]) + value + END
            case 3:
                stream += bytes([IAC, WILL + size % 4, (0, 1, 3, OPTION, code)[code % 5]])
            case 4:
                stream += bytes([IAC, code])
            case 5:
                stream += BEGIN + bytes([code]) * size
            case 6:
                stream += bytes([IAC, IAC]) + value
            case _:
                stream += bytes([code]) + value
    return stream


def seeds(folder: Path) -> None:
    """Write seed inputs: clients' bytes, well formed and malformed."""
    for negotiation in WELL_FORMED + ODD:
        (folder / negotiation).write_bytes(b"\0" + BEGIN + bytes.fromhex(negotiation) + END + b"B\n")
    options = "ff fd 2c ff fb 2c ff fe 2c ff fc 01 ff fb 00 ff fd 63"
    (folder / "options").write_bytes(b"\0" + bytes.fromhex(options))
    (folder / "bare").write_bytes(b"\0ff" + END)
    (folder / "long").write_bytes(b"\0" + BEGIN + bytes(300))
    (folder / "recipe").write_bytes(bytes([RECIPE]) + bytes(range(64)))


def main() -> None:
    """Run libFuzzer with options of the command line."""
    fuzz(check, seeds, ("serial.rfc2217", "khep_twin.ports.negotiation"), "-max_len=48")
