"""kh4server on a dsPIC: replies to the byte, by the manual and the published program."""

import pytest
from dspic_words import set_words

from khep_twin.robots.khepera4.dspic import Dspic
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.server import Kh4Server


def sensing() -> Dspic:
    dspic = Dspic()
    set_words(dspic, DspicRegister.PROXIMITY, range(12))
    set_words(dspic, DspicRegister.AMBIENT, range(900, 912))
    set_words(dspic, DspicRegister.ULTRASONIC, [25, 2000, 1000, 0, 250])
    set_words(dspic, DspicRegister.GYROSCOPE, range(-15, 15))
    set_words(dspic, DspicRegister.ACCELEROMETER, [-16384] * 30)
    battery = (
        bytes([3])
        + (2000).to_bytes(2, "little")
        + bytes([80])
        + (-1000).to_bytes(2, "little", signed=True)
        + (-500).to_bytes(2, "little", signed=True)
        + (6400).to_bytes(2, "little")
        + (800).to_bytes(2, "little")
    )
    for index, byte in enumerate(battery):
        dspic.state.memory[DspicRegister.BATTERY + index] = byte
    return dspic


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("B", "b,B,0"),
        ("D,100,-100", "d"),
        ("E", "e,0,0"),
        ("F,1000,-1000", "f"),
        ("G", "g,25,2000,1000,0,250"),
        ("H,10,5,1", "h"),
        ("I", "i"),
        ("J,3,0,20,1,400", "j"),
        ("K,1,2,3,4,5,6,7,8,9", "k"),
        ("K,1,2,3", "$"),
        ("L,500,500", "l"),
        ("M", "m"),
        ("N", "n,0,1,2,3,4,5,6,7,8,9,10,11"),
        ("O", "o,900,901,902,903,904,905,906,907,908,909,910,911"),
        ("P,20", "p"),
        ("R", "r,0,0"),
        ("S", f"s,{','.join(map(str, range(-15, 15)))}"),
        ("T", f"t{',-16384' * 30}"),
        ("U,31", "u"),
        ("V,0", "v,7808"),
        ("V,1", "v,-78"),
        ("V,2", "v,-39"),
        ("V,3", "v,3200"),
        ("V,4", "v,25.0"),
        ("V,5", "v,80"),
        ("V,6", "v,0"),
        ("V,7", "v,3"),
        ("V,8", "$"),
        ("V,-1", "$"),
        ("V,65541", "v,80"),
        ("D, 5,6x,,7", "d"),
        ("B" + "x" * 200, "b,B,0"),
        ("K,1,2,3,4,5,6,7,8,9,10", "$"),
        ("V", "$"),
        ("A,2", "a"),
        ("A,3", "$"),
        ("Z", "z"),
        ("C,1,1", "$"),
        ("n", "$"),
        ("0", "$"),
    ],
)
def test_each_command_has_the_reply_of_the_published_program(command: str, reply: str) -> None:
    assert Kh4Server(sensing()).receive(command.encode() + b"\n") == reply.encode() + b"\r\n"


def test_a_command_ends_with_its_line_and_later_input_is_discarded() -> None:
    server = Kh4Server(sensing())
    assert server.receive(b"E") == b""
    assert server.receive(b"\r\n") == b"e,0,0\r\n"
    assert server.receive(b"\n\r\n") == b""
    assert server.receive(b"E\nR\nR\n") == b"e,0,0\r\n"
    assert server.receive(b"R\n") == b"r,0,0\r\n"


def test_orders_reach_the_registers_with_their_control_type() -> None:
    dspic = Dspic()
    server = Kh4Server(dspic)
    server.receive(b"\n")
    assert dspic.read(DspicRegister.POSITION_MARGIN, 2) == bytes([20, 0])
    for command, control, register, content in (
        (b"D,300,-2\n", Control.SPEED, DspicRegister.SPEED_ORDER_LEFT, bytes([44, 1, 254, 255])),
        (b"L,-1\n", Control.OPEN_LOOP, DspicRegister.PWM_ORDER_LEFT, bytes([255, 255, 0, 0])),
        (
            b"F,65536,x\n",
            Control.POSITION,
            DspicRegister.POSITION_ORDER_LEFT,
            bytes([0, 0, 1, 0, 0, 0, 0, 0]),
        ),
    ):
        server.receive(command)
        assert dspic.read(DspicRegister.CONTROL, 1) == bytes([control])
        assert dspic.read(register, len(content)) == content
    server.receive(b"K,64,65,63,0,0,0,0,0,255\n")
    assert dspic.leds == bytes([0, 1, 63, 0, 0, 0, 0, 0, 63])


def test_the_binary_reply_has_the_published_programs_length_and_shift() -> None:
    dspic = sensing()
    dspic.tick(70_000, -3)
    reply = Kh4Server(dspic).receive(b"X\n")
    assert len(reply) == 128
    assert reply[:1] == b"x"
    assert reply[1:5] == bytes([0, 1, 0, 2])  # proximity from its second byte on
    assert reply[23:27] == bytes([0, 0, 3, 133])  # behind the last one a byte that nothing has set
    assert reply[57:67] == (70_000).to_bytes(4, "little") + (-3).to_bytes(4, "little", signed=True) + b"\n\r"


def orders(dspic: Dspic) -> tuple[int, int]:
    content = dspic.read(DspicRegister.SPEED_ORDER_LEFT, 4)
    left, right = (int.from_bytes(part, "little", signed=True) for part in (content[:2], content[2:]))
    return left, right


def test_its_vehicle_drives_avoids_turns_where_it_is_blocked_and_stops() -> None:
    dspic = Dspic()
    server = Kh4Server(dspic)
    server.receive(b"A,0\n")
    server.tick()
    assert orders(dspic) == (200, 200)
    set_words(dspic, DspicRegister.PROXIMITY, [0, 0, 300, 0, 0, 0, 0, 0])  # front left
    server.tick()
    assert orders(dspic) == (200 + 4 * 110 // 3, 200 - 4 * 110 // 3)
    set_words(dspic, DspicRegister.PROXIMITY, [0, 0, 0, 400, 0, 0, 0, 0])
    for _ in range(6):
        server.tick()
    assert orders(dspic) == (120, -120)
    set_words(dspic, DspicRegister.PROXIMITY, [0] * 8)
    server.tick()
    assert orders(dspic) == (200, 200)
    assert server.receive(b"E\n") == b"e,0,0\r\n"
    server.receive(b"L,0,0\n")
    server.tick()
    assert dspic.read(DspicRegister.PWM_ORDER_LEFT, 4) == bytes([200, 0, 200, 0])
    for end, reply in ((b"A,2\n", b"a\r\n"), (b"A,3\n", b"$\r\n"), (b"A\n", b"$\r\n")):
        server.receive(b"A,1\n")
        server.tick()
        assert orders(dspic) == (200, 200)
        assert server.receive(end) == reply
        server.tick()
        assert orders(dspic) == (0, 0)
        assert dspic.read(DspicRegister.CONTROL, 1) == bytes([Control.IDLE])
