"""Effects of each command on the board, as transcripts written from the manual's facts."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.board.kernel import LEFT, RIGHT, Board, Wheel
from khep_twin.board.rom import ROMS
from khep_twin.firmware import Firmware


@pytest.fixture
def firmware() -> Firmware:
    return Firmware(ROMS["5.02"])


def ask(firmware: Firmware, line: str) -> str:
    """The reply to one line, without its ending."""
    reply = firmware.receive(line.encode("latin-1") + b"\n")
    assert reply.endswith(b"\r\n")
    assert reply.count(b"\r\n") == 1
    return reply[:-2].decode("ascii")


@pytest.mark.parametrize(
    ("line", "reply"),
    [
        ("A,3800,800,100", "a"),
        ("B", "b,5.02,5.01"),
        ("C,1000,-1000", "c"),
        ("D,5,-5", "d"),
        ("E", "e,0,0"),
        ("F,3000,20,4000", "f"),
        ("G,0,0", "g"),
        ("H", "h,0,0"),
        ("I,0", "i,0"),
        ("I,5", "i,0"),
        ("I,6", "i,0"),
        ("J,20,64,20,64", "j"),
        ("K", "k,1,0,0,1,0,0"),
        ("L,0,1", "l"),
        ("N", "n,0,0,0,0,0,0,0,0"),
        ("O", "o,0,0,0,0,0,0,0,0"),
        ("P,100,-100", "p"),
        ("R,0", "r,255"),
        ("T,1,B", "z,Turret order not supported"),
        ("W,1,2", "w"),
        ("D,5", "z,Protocol error"),
        ("J,20,64", "z,Protocol error"),
        ("L,2,0", "z,Protocol error"),
        ("L,0,3", "z,Protocol error"),
        ("I,7", "z,Protocol error"),
        ("R,64", "z,Protocol error"),
        ("W,256,0", "z,Protocol error"),
        ("hello", "Command not found"),
        ("d,5,5", "Command not found"),
        (" ", "Command not found"),
        ("Q", "Command not found"),
    ],
)
def test_every_line_gets_its_reply(firmware: Firmware, line: str, reply: str) -> None:
    assert ask(firmware, line) == reply


def test_a_burst_is_answered_in_order(firmware: Firmware) -> None:
    assert firmware.receive(b"B\nE\r\nH\rxx\n\nD,1,1\n") == (
        b"b,5.02,5.01\r\ne,0,0\r\nh,0,0\r\nCommand not found\r\nd\r\n"
    )


def test_single_bytes_are_as_good_as_a_line(firmware: Firmware) -> None:
    replies = [firmware.receive(bytes((byte,))) for byte in b"G,7,-8\nH\n"]
    assert b"".join(replies) == b"g\r\nh,7,-8\r\n"
    assert replies[:6] == [b""] * 6


@pytest.mark.parametrize(
    ("line", "register", "left", "right"),
    [
        ("D,128,-1000", Wheel.SPEED_SETPOINT, 127, -127),
        ("P,256,-9999", Wheel.DUTY, 255, -255),
        ("C,99999999,-99999999", Wheel.TARGET, 2**23 - 2, -(2**23) + 2),
        ("J,200,0,-1,99999999", Wheel.MAX_SPEED, 127, 0),
        ("J,200,0,-1,99999999", Wheel.ACCELERATION, 1, 65535),
        ("G,2147483648,-2147483649", Wheel.POSITION, -(2**31), 2**31 - 1),
    ],
)
def test_numbers_out_of_range_are_cut_to_it(
    firmware: Firmware, line: str, register: Wheel, left: int, right: int
) -> None:
    ask(firmware, line)
    assert (firmware.register_view[LEFT + register], firmware.register_view[RIGHT + register]) == (
        left,
        right,
    )


def test_gains_are_kept_within_sixteen_bits(firmware: Firmware) -> None:
    ask(firmware, "A,-1,40000,5")
    assert [firmware.register_view[Board.SPEED_KP + offset] for offset in range(3)] == [0, 32767, 5]
    ask(firmware, "F,1,2,3")
    assert [firmware.register_view[Board.POSITION_KP + offset] for offset in range(3)] == [1, 2, 3]


def test_leds_go_on_off_and_over(firmware: Firmware) -> None:
    states = []
    for action in (1, 2, 2, 0):
        ask(firmware, f"L,1,{action}")
        states.append(firmware.register_view[Board.LED_1])
    assert states == [1, 0, 1, 0]
    assert firmware.register_view[Board.LED_0] == 0


def test_channels_1_and_2_follow_the_sensor_converted_last(firmware: Firmware) -> None:
    firmware.register_view[Board.PROXIMITY + 2] = 321
    firmware.register_view[Board.AMBIENT + 2] = 123
    firmware.register_view[Board.SCAN] = 3
    assert (ask(firmware, "I,1"), ask(firmware, "I,2")) == ("i,321", "i,123")


@pytest.mark.parametrize(("rom", "speed", "position", "pwm"), [("5.02", 0, 1, 2), ("4.06", 1, 0, 2)])
def test_the_rom_says_how_modes_are_counted(rom: str, speed: int, position: int, pwm: int) -> None:
    firmware = Firmware(ROMS[rom])
    modes = []
    for line in ("D,1,1", "C,1,1", "P,1,1"):
        ask(firmware, line)
        modes.append(int(ask(firmware, "K").split(",")[2]))
    assert modes == [speed, position, pwm]


def test_restart_puts_all_back_and_shows_the_banner(firmware: Firmware) -> None:
    ask(firmware, "D,9,9")
    lines = firmware.receive(b"restart\r").split(b"\r\n")
    assert lines[0].startswith(b"ROM of minirobot KHEPERA")
    assert lines[-2:] == [b"Serial Communication Protocol", b""]
    assert ask(firmware, "K") == "k,1,0,0,1,0,0"
    assert firmware.register_view[LEFT + Wheel.SPEED_SETPOINT] == 0


@given(st.lists(st.binary(max_size=60), max_size=30))
def test_rubbish_is_answered_line_by_line_in_plain_ascii(chunks: list[bytes]) -> None:
    firmware = Firmware(ROMS["5.02"])
    stream = b"".join(chunks)
    replies = b"".join(firmware.receive(chunk) for chunk in chunks)
    assert replies.isascii()
    lines = [line for line in stream.replace(b"\r", b"\n").split(b"\n")[:-1] if line]
    tools = (b"restart", b"help", b"list", b"k-team", b"memory", b"process", b"run")
    if not any(tool in stream for tool in tools):
        assert replies.count(b"\r\n") == len(lines)
    assert firmware.receive(b"\nB\n").endswith(b"b,5.02,5.01\r\n")


@pytest.mark.parametrize(
    ("rom", "mode", "baud", "remedy"),
    [
        ("5.02", 1, 38400, "for 38400 baud: serve --mode 3, or khep://...?mode=3"),
        ("5.02", 3, 9600, "for 9600 baud: serve --mode 1, or khep://...?mode=1"),
        ("khepera2", 1, 115200, "for 115200 baud: serve --mode 9, or khep://...?mode=9"),
        (
            "4.06",
            1,
            57600,
            "for 57600 baud, of a Khepera II: serve --model khepera2 --mode 8, or "
            "khep://...?model=khepera2&mode=8",
        ),
        ("5.02", 1, 1200, "no running mode has 1200 baud: expected 9600 at the host"),
    ],
)
def test_the_remedy_for_another_speed_is_the_mode_that_has_it(
    rom: str, mode: int, baud: int, remedy: str
) -> None:
    assert Firmware(ROMS[rom], mode).baud_rate_hint(baud) == remedy


def test_the_remedy_for_a_speed_that_the_tool_serial_has_left_is_a_restart() -> None:
    firmware = Firmware(ROMS["5.02"], 1)
    firmware.receive(b"serial 38400\n")
    assert firmware.baud_rate_hint(9600) == "'restart' brings the robot back to 9600 baud"
