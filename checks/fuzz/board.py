"""A fuzz target: arbitrary bytes on the line, in pieces of any size, between any ticks.

    python -m checks fuzz-board -runs=1000000        with atheris (libFuzzer)

The first byte chooses the board, 0xFE runs a control tick, 0xFD cuts the bytes into pieces; all others
cross the line. `check` has the conditions.
"""

from pathlib import Path

from checks.fuzz.libfuzzer import fuzz
from tools.command_table import ROOT

TRANSCRIPTS = ROOT / "tests" / "data" / "transcripts"
TICK, CUT = 0xFE, 0xFD


def check(data: bytes) -> None:
    """Feed one input to a board and check its reaction.

    Raises:
        AssertionError: A reply is not in ASCII lines that end in CR LF, a line got none, a register left its
            range, or the board is out of step afterwards.
    """
    from khep_twin.board import kernel
    from khep_twin.board.kernel import DUTIES, LEFT, RIGHT, Wheel
    from khep_twin.board.rom import ROMS
    from khep_twin.board.turrets import find_turrets
    from khep_twin.firmware import Firmware

    choice, stream = (data[0] if data else 0), data[1:]
    rom = ROMS[list(ROMS)[choice % len(ROMS)]]
    turrets = {kind: kind.make() for kind in find_turrets(["gripper"] if choice & 0x40 else [])}
    firmware = Firmware(rom, 1, turrets)
    replies, sent, encoder = b"", b"", 0
    for piece in stream.replace(bytes([TICK]), bytes([CUT, TICK, CUT])).split(bytes([CUT])):
        if piece == bytes([TICK]):
            encoder += 7
            firmware.tick(encoder, -encoder)
            kernel.convert(firmware.register_view, 512, 300)
        else:
            replies += firmware.receive(piece)
            sent += piece
    lines = [line for line in sent.replace(b"\r", b"\n").split(b"\n")[:-1] if line]
    reply_lines = replies.split(b"\r\n")
    assert replies.isascii(), replies
    assert reply_lines.pop() == b"", replies
    assert b"\r" not in b"".join(reply_lines), replies
    assert b"\n" not in b"".join(reply_lines), replies
    assert len(reply_lines) >= len(lines), (lines, reply_lines)
    assert all(reply_lines), replies
    for register in DUTIES:
        assert -255 <= firmware.register_view[register] <= 255
    for wheel in (LEFT, RIGHT):
        assert -(2**31) <= firmware.register_view[wheel + Wheel.POSITION] < 2**31
        assert firmware.register_view[wheel + Wheel.MODE] in (0, 1, 2)
    version = b"b,%s,%s\r\n" % (rom.bios.encode(), rom.protocol.encode())
    assert firmware.receive(b"\nB\n").endswith(version)


def seeds(folder: Path) -> None:
    """Write the hosts' bytes of the transcripts as seed inputs."""
    for transcript in TRANSCRIPTS.glob("*.txt"):
        host_lines = [line[2:] for line in transcript.read_text().splitlines() if line.startswith("> ")]
        for number, line in enumerate(host_lines):
            (folder / f"{transcript.stem}-{number}").write_bytes(b"\x40" + line.encode() + b"\n\xfe")
        (folder / transcript.stem).write_bytes(b"\x40" + "\n".join(host_lines).encode() + b"\n")


def main() -> None:
    """Run libFuzzer with options of the command line."""
    modules = ("khep_twin", "khep_twin.firmware", "khep_twin.board.gripper_body")
    fuzz(check, seeds, modules, "-max_len=512")
