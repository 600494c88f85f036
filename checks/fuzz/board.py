"""A fuzz target: arbitrary bytes on the line, in pieces of any size, between any ticks.

    python -m checks fuzz-board -runs=1000000        with atheris (libFuzzer)

The first byte chooses the board, a Khepera IV's with the highest bit, a Khepera III's also with the next one.
The latter has a bus: a piece that starts with the address of a device is a message to it. 0xFE runs a control
tick, 0xFD cuts the bytes into pieces; all others cross the line. `check` has the conditions.
"""

from functools import cache
from pathlib import Path
from typing import Any

from checks.fuzz.libfuzzer import fuzz
from tools.command_table import ROOT

TRANSCRIPTS = ROOT / "tests" / "data" / "transcripts"
TICK, CUT = 0xFE, 0xFD

KHEPERA4 = 0x80
"""Bit of the first byte for a Khepera IV."""

KHEPERA4_COMMANDS = (
    *(
        b"B",
        b"D,200,-150",
        b"E",
        b"F,900,-800",
        b"G",
        b"H,10,5,1",
        b"I",
        b"J,3,0,20,1,400",
        b"K,1,2,3,4,5,6,7,8,9",
    ),
    *(
        b"L,900,-900",
        b"M",
        b"N",
        b"O",
        b"P,20",
        b"R",
        b"S",
        b"T",
        b"U,31",
        b"V,0",
        b"X",
        b"Z",
        b"A,0",
        b"A,2",
    ),
)
"""Commands of kh4server."""


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
    if choice & KHEPERA4:
        (check_khepera3 if choice & 0x40 else check_khepera4)(stream)
        return
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


def check_khepera4(stream: bytes) -> None:
    """Feed one input to the server of a Khepera IV and check its reaction.

    Raises:
        AssertionError: A reply has another form, a register left its range, or the server is out of step
            afterwards.
    """
    from khep_twin.robots.khepera4.dspic import Dspic
    from khep_twin.robots.khepera4.motor_control import PWM_LIMIT
    from khep_twin.robots.khepera4.server import BINARY_BYTES, Kh4Server

    dspic = Dspic()
    server, pulses = Kh4Server(dspic), 0
    for piece in stream.replace(bytes([TICK]), bytes([CUT, TICK, CUT])).split(bytes([CUT])):
        if piece == bytes([TICK]):
            pulses += 70
            pwm = dspic.tick(pulses, -pulses)
            server.tick()
            assert all(-PWM_LIMIT <= value <= PWM_LIMIT for value in pwm), pwm
            continue
        reply = server.receive(piece)
        if reply.startswith(b"x") and len(reply) == BINARY_BYTES:
            continue
        is_line = (
            reply.isascii() and reply.endswith(server.end) and reply.count(b"\r") == reply.count(b"\n") == 1
        )
        assert not reply or is_line, reply
    numbers = [*dspic.state.motors]
    assert all(-(2**31) <= number < 2**31 for number in numbers), numbers
    server.receive(b"\n")
    assert server.receive(b"B\n") == b"b,B,0\r\n"
    assert server.receive(b"b\n") == b"$\r\n"


@cache
def khepera3_world() -> tuple[Any, bytes]:
    """Return a world with a Khepera III, and its state at the start."""
    from khep_twin.world import World

    world = World("arena3", compiled=False)
    return world, world.snapshot()


def check_khepera3(stream: bytes) -> None:
    """Feed one input to the line and the bus of a Khepera III and check their reaction.

    Raises:
        AssertionError: A PWM or a number left its range, or line or bus are out of step afterwards.
    """
    world, start = khepera3_world()
    world.restore(start)
    robot = world.robots[0]
    for piece in stream.replace(bytes([TICK]), bytes([CUT, TICK, CUT])).split(bytes([CUT])):
        if piece == bytes([TICK]):
            world.advance(0.01)
            for pwm in robot.readings()["duty"]:
                assert -1023 <= pwm <= 1023, pwm
        elif piece and (device := robot.bus.devices.get(piece[0])):
            device.write(piece[1:] or piece)
            assert len(device.read(29)) == 29
        else:
            robot.firmware.receive(piece)
    world.restore(world.snapshot())
    robot.bus.dspic.write(b"\x02B")
    assert robot.bus.dspic.read(7) == b"\x05\x00b\x03\x00\x00\x00"
    assert robot.firmware.receive(b"\nB\n").endswith(b"b,3,0\n\r")


def seeds(folder: Path) -> None:
    """Write the hosts' bytes of the transcripts, and commands of kh4server, as seed inputs."""
    for number, command in enumerate(KHEPERA4_COMMANDS):
        (folder / f"khepera4-{number}").write_bytes(bytes([KHEPERA4]) + command + b"\r\n\xfe")
        (folder / f"khepera3-{number}").write_bytes(bytes([KHEPERA4 | 0x40]) + command + b"\n\xfe")
    for number, message in enumerate(
        (b"\x31\x03G\x03", b"\x31\x02N", b"\x29\x28\x01", b"\x2a\x2f\x7f", b"\x68\x00")
    ):
        (folder / f"khepera3-bus-{number}").write_bytes(bytes([KHEPERA4 | 0x40, CUT]) + message + b"\xfe\xfe")
    for transcript in TRANSCRIPTS.glob("*.txt"):
        host_lines = [line[2:] for line in transcript.read_text().splitlines() if line.startswith("> ")]
        for number, line in enumerate(host_lines):
            (folder / f"{transcript.stem}-{number}").write_bytes(b"\x40" + line.encode() + b"\n\xfe")
        (folder / transcript.stem).write_bytes(b"\x40" + "\n".join(host_lines).encode() + b"\n")


def main() -> None:
    """Run libFuzzer with options of the command line."""
    modules = (
        *("khep_twin", "khep_twin.firmware", "khep_twin.board.gripper_body"),
        *("khep_twin.robots.khepera3", "khep_twin.robots.khepera4"),
    )
    fuzz(check, seeds, modules, "-max_len=512")
