"""Letters of a Khepera III's firmware and of kh3server, to the byte, by manual and published programs."""

import random
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from khep_twin.firmware import FirmwareState
from khep_twin.robots.khepera3 import state as indices
from khep_twin.robots.khepera3.bus import Bus
from khep_twin.robots.khepera3.letters import Letters, program_of
from khep_twin.robots.khepera3.model import FIRST, KHEPERA_3, SERVER
from khep_twin.robots.khepera3.motor_control import power_up
from khep_twin.robots.khepera3.registers import SETTINGS, ControlType, MotorRegister, PicMode
from khep_twin.robots.vehicle import N_VEHICLE, WANDERING

FIRMWARE = "3.0"
END = {FIRMWARE: b"\n\r", SERVER: b"\r\n"}
PROXIMITY = [-1, 95, 8, 300, 54, 122, 19, 120, 101, 3972, 3978]
EMPTY_ECHOES = ",0,0,0" * 4


class Robot(NamedTuple):
    """A program on a bus whose state stands still."""

    state: Any
    bus: Bus
    letters: Letters

    def ask(self, *requests: str) -> list[str]:
        """Send requests, one after the other; return the replies without their end."""
        end = END[self.letters.program]
        replies = [self.letters.receive(request.encode() + b"\n") for request in requests]
        assert all(reply.endswith(end) for reply in replies if reply)
        return [reply.removesuffix(end).decode() for reply in replies]

    def numbers(self, register: int, size: int) -> list[int]:
        return [motor.get(register, size) for motor in self.bus.motors]

    def set_proximity(self, values: list[int]) -> None:
        self.state.registers[FIRST["proximity"] :][:11] = values


def robot(rom: str = FIRMWARE) -> Robot:
    board = np.zeros(indices.N_BOARD, np.int64)
    board[indices.POWERED], board[indices.SETTING :] = 1, SETTINGS
    state: Any = SimpleNamespace(
        left=power_up(-1),
        right=power_up(1),
        board=board,
        echoes=np.zeros(5 * indices.N_ECHO, np.int64),
        battery=np.array([0.0, 0.2, 1.25]),
        vehicle=np.zeros(N_VEHICLE, np.int64),
        registers=np.zeros(KHEPERA_3.interface.n_registers, np.int64),
    )
    state.echoes[2 * indices.N_ECHO :][:4] = 1, 27, 2900, 100_000
    bus = Bus(state, KHEPERA_3)
    new_robot = Robot(state, bus, program_of(bus, rom))
    new_robot.set_proximity(PROXIMITY)
    return new_robot


COMMON = [
    ("B", "b,3,0"),
    ("D,l20000,l-20000", "d"),
    ("E", "e,0,0"),
    ("F,l1000,l1000", "f"),
    ("G,3", f"g,1,27,2900,100000{EMPTY_ECHOES},1800"),
    ("G,1", f"g,0,0,0,0{EMPTY_ECHOES},1800"),
    ("H,d1,d200,d5,d10", "h"),
    ("I,l1000,l1000", "i"),
    ("J,d15000,10", "j"),
    ("K,0,1", "k"),
    ("L,l500,l500", "l"),
    ("M", "m"),
    ("O", "o" + ",0" * 12),
    ("P,l1000,l1000", "p"),
    ("R", "r,0,0"),
    ("V,0", "v,8,2000"),
    ("V,1", "v,-0,2000"),
    ("V,2", "v,-1,2500"),
    ("V,3", "v,1400"),
    ("V,4", "v,25,0"),
    ("V,5", "v,100"),
    ("Z", "z"),
    ("C,0,d3", "c"),
    ("A,2", "a"),
    *(
        (request, "$")
        for request in ("V,6", "V", "A,3", "A", "Q", "S", "T", "U", "W", "Y", "b", "0", "hello")
    ),
]
FIRMWARE_ONLY = [
    ("N", f"n,{','.join(map(str, PROXIMITY))},0"),
    ("G,9", "$"),
    ("D", "$"),
    ("D,l5", "$"),
    ("D,500,500", "$"),
    ("D,d500,d500", "d"),
    ("D,d40000,d70000", "$"),
    ("D,l3000000000,l0", "$"),
    ("D,x,y", "$"),
    ("D,,l5", "$"),
    ("D,0,0", "d"),
    (" D , l5 , l6 ,7", "d"),
    ("Bxyz", "$"),
    ("K,0", "$"),
]
SERVER_ONLY = [
    ("N", f"n,65535,{','.join(map(str, PROXIMITY[1:]))},0"),
    ("G,9", ""),
    ("D", "d"),
    ("D,500,500", "d"),
    ("H", "h"),
    ("Bxyz", "b,3,0"),
    (" B", "$"),
    ("V,1,2", "$"),
    ("V,65536", "v,8,2000"),
    ("\0", "$"),
]


@pytest.mark.parametrize(
    ("rom", "request_line", "reply"),
    [
        *((rom, *pair) for rom in (FIRMWARE, SERVER) for pair in COMMON),
        *((FIRMWARE, *pair) for pair in FIRMWARE_ONLY),
        *((SERVER, *pair) for pair in SERVER_ONLY),
    ],
)
def test_each_command_has_the_reply_of_its_program(rom: str, request_line: str, reply: str) -> None:
    assert robot(rom).ask(request_line) == [reply]


def test_a_charge_has_three_digits_only_from_the_server() -> None:
    for rom, reply in ((FIRMWARE, "v,7"), (SERVER, "v,007")):
        almost_empty = robot(rom)
        almost_empty.state.battery[indices.USED] = indices.CAPACITY - 7 * 3.6
        assert almost_empty.ask("V,3") == [reply]


@pytest.mark.parametrize(("rom", "profile"), [(FIRMWARE, (20_000, 64)), (SERVER, (15_000, 10))])
def test_both_programs_configure_the_motors_at_their_start_and_by_m(
    rom: str, profile: tuple[int, int]
) -> None:
    started = robot(rom)
    started.state.left.memory[:] = started.state.right.memory[:] = 1
    for _ in range(2):
        started.letters.receive(b"\n")
        left, right = started.bus.motors
        assert [left.get(MotorRegister.OPTIONS, 1) & 0xFF, right.get(0x2B, 1)] == [0xA2, 0x22]
        for register, size, value in (
            (MotorRegister.MODE, 1, PicMode.IDLE),
            (MotorRegister.SAMPLE_TIME, 2, 1550),
            (MotorRegister.MARGIN, 1, 6),
            (MotorRegister.ERRORS, 1, 0),
            (MotorRegister.BLOCKED_TIME, 1, 10),
            (MotorRegister.SPEED_GAINS, 2, 620),
            (MotorRegister.SPEED_GAINS + 2, 2, 3),
            (MotorRegister.POSITION_GAINS + 4, 2, 30),
            (MotorRegister.LOWEST, 4, -10_000),
            (MotorRegister.TOP_SPEED, 2, profile[0]),
            (MotorRegister.ACCELERATION, 1, profile[1]),
        ):
            assert started.numbers(register, size) == [value, value]
        started.ask("D,l1,l1", "H,d0,d1,d2,d3", "J,d5,d6")
        started.state.left.memory[MotorRegister.ERRORS] = 16
        assert started.ask("M") == ["m"]


def test_orders_reach_both_controllers_with_their_control_type() -> None:
    for letter, control in (
        ("D", ControlType.SPEED),
        ("F", ControlType.POSITION_PROFILE),
        ("P", ControlType.POSITION),
        ("L", ControlType.OPEN_LOOP),
    ):
        ordered = robot()
        ordered.ask(f"{letter},l70000,l-2")
        assert ordered.numbers(MotorRegister.MODE, 1) == [PicMode.NORMAL] * 2
        assert ordered.numbers(MotorRegister.CONTROL, 1) == [control] * 2
        assert ordered.numbers(MotorRegister.SET_POINT, 4) == [70_000, -2]
    ordered.ask("H,d1,d200,d5,d10", "I,l5,l-70000", "K,1,1", "K,0,2", "C,4,d65535", "C,0,d21")
    assert ordered.numbers(MotorRegister.POSITION_GAINS, 2) == [200, 200]
    assert ordered.numbers(MotorRegister.POSITION_GAINS + 2, 2) == [10, 10]  # Kd is the last number
    assert ordered.ask("R") == ["r,5,-70000"]
    assert ordered.state.board[indices.LEDS :][:2].tolist() == [1, 1]
    assert ordered.state.board[indices.SETTING :][:5].tolist() == [21, 3, 0, 0, 65535]


@pytest.mark.parametrize(
    ("numbers", "set_points"),
    [
        ("20000,20000", [0, 0]),
        ("l20000,l-20000", [20_000, -20_000]),
        ("x500,9500", [500, 500]),
        ("l12.7,l-3.9", [12, -3]),
        ("l-1000000000,50", [-10_000_000, 0]),  # the second number is in the bytes of the first
        ("l1234567890123,l5", [123_456_789, 5]),
        (",,l5,,l6", [5, 6]),
        ("l5", [5, 0]),
        ("ll5,l", [0, 0]),
        ("l+5,l 6", [5, 6]),
    ],
)
def test_the_server_reads_numbers_from_its_memory(numbers: str, set_points: list[int]) -> None:
    server = robot(SERVER)
    assert server.ask(f"D,{numbers}") == ["d"]
    assert server.numbers(MotorRegister.SET_POINT, 4) == set_points


def test_the_server_answers_one_of_several_commands_and_the_firmware_each() -> None:
    assert robot(SERVER).letters.receive(b"B\nB\r\nB\r") == b"b,3,0\r\n"
    assert robot().letters.receive(b"B\nE\r\nR\r") == b"b,3,0\n\re,0,0\n\rr,0,0\n\r"
    for rom in (FIRMWARE, SERVER):
        letters = robot(rom).letters
        assert letters.receive(b"D,l50") == b""
        assert letters.receive(b"0,l500") == b""
        assert letters.receive(b"\r\n") == b"d" + END[rom]
        assert letters.receive(b"\n\r\n") == b""


def test_the_binary_reply_has_readings_speeds_positions_and_time() -> None:
    for rom in (FIRMWARE, SERVER):
        binary = robot(rom)
        binary.ask("I,l1000,l-2")
        binary.state.board[indices.SCAN_MS] = 330
        reply = binary.letters.receive(b"X\r")
        assert len(reply) == 67
        assert reply[:5] == b"x\xff\xff\x5f\x00"
        assert reply[53:61] == b"\xe8\x03\0\0\xfe\xff\xff\xff"
        assert reply[61:] == b"\x4a\x01\0\0\n\r"


def test_a_robot_without_power_is_silent_and_its_program_starts_again() -> None:
    off = robot()
    assert off.letters.state().running == ""
    off.ask("D,l5,l5", "C,0,d31", "K,0,1", "A,0")
    assert off.letters.state() == FirmwareState(115_200, 115_200, "3.0", b"", {})
    assert off.letters.reset() == b""
    assert (off.letters.state().running, off.state.vehicle.tolist()) == ("", [0] * 5)
    assert off.numbers(MotorRegister.SET_POINT, 4) == [0, 0]
    assert off.state.board[indices.LEDS :].tolist() == [0, 0, *SETTINGS]
    off.state.board[indices.POWERED] = 0
    assert off.letters.receive(b"B\n") == b""
    with pytest.raises(ValueError, match="expected 115200 baud, 'kh3server'"):
        robot(SERVER).letters.set_state(off.letters.state()._replace(running="3.0"))


# The vehicle -------------------------------------------------------------------------------------------


def rounds(wanderer: Robot, count: int = 1) -> list[int]:
    """Run rounds of the vehicle; return the speeds that it has set."""
    for _ in range(count):
        wanderer.letters.tick()
    return wanderer.numbers(MotorRegister.SET_POINT, 4)


def test_the_server_drives_by_the_sensors_from_the_second_one_on() -> None:
    wanderer = robot(SERVER)
    wanderer.set_proximity([0] * 11)
    wanderer.ask("I,l5000,l5000", "A,0")
    assert rounds(wanderer) == [20 * 256, 20 * 256]
    wanderer.set_proximity([300] + [0] * 10)
    assert rounds(wanderer) == [20 * 256, 20 * 256]
    wanderer.set_proximity([0] * 9 + [3978, 0])  # white floor below the right one
    assert rounds(wanderer) == [80 * 256, 80 * 256]
    wanderer.set_proximity([0, 0, 0, 0, 300, 0, 0, 0, 0, 0, 0])
    assert rounds(wanderer) == [(20 + 5 * 100 // 30) * 256, -20 * 256]
    wanderer.set_proximity([0, -1, *[0] * 9])  # 65535
    assert rounds(wanderer) == [50 * 256, 50 * 256]


def test_the_firmware_drives_by_the_sensors_around_it_with_its_gain() -> None:
    wanderer = robot()
    wanderer.set_proximity([0, 0, 0, 0, 300, 0, 0, 0, 0, 3978, 3978])
    wanderer.ask("A,0")
    assert rounds(wanderer) == [-20 * 256, (20 + 5 * 100 // 30) * 256]
    wanderer.ask("C,5,d3")
    assert rounds(wanderer) == [10 * 256, (20 + 5 * 100 // 120) * 256]
    wanderer.ask("C,0,d31", "C,5,d12", "A,1")
    wanderer.set_proximity([0] * 11)
    assert rounds(wanderer) == [(20 - 7 * 380 // 30) * 256] * 2  # 27 cm ahead


def test_a_vehicle_that_does_not_move_turns_in_place_until_nothing_is_ahead() -> None:
    for rom in (FIRMWARE, SERVER):
        wanderer = robot(rom)
        wanderer.set_proximity([0, 0, 0, 0, 260, 0, 0, 0, 0, 0, 0])
        wanderer.ask("I,l5000,l5000", "A,0")
        assert rounds(wanderer, 5) != [12_800, -12_800]
        assert rounds(wanderer) == [12_800, -12_800]
        wanderer.ask("D,l0,l0")
        assert rounds(wanderer, 9) == [0, 0]  # it waits
        wanderer.set_proximity([0] * 11)
        assert rounds(wanderer) == [20 * 256, 20 * 256]
        wanderer.ask("I,l9000,l9000")
        assert rounds(wanderer, 6) == [20 * 256, 20 * 256]
    near_zero = robot(SERVER)  # where unsigned numbers are never less than 700 apart
    near_zero.set_proximity([0] * 11)
    near_zero.ask("A,0")
    assert rounds(near_zero, 20) == [20 * 256, 20 * 256]


def test_an_a_2_ends_one_vehicle_of_the_server_and_all_of_the_firmware() -> None:
    for rom, n_left in ((FIRMWARE, 0), (SERVER, 1)):
        wanderer = robot(rom)
        assert wanderer.ask("A,0", "A,1", "A,2") == ["a"] * 3
        assert wanderer.state.vehicle[WANDERING] == n_left
        assert wanderer.numbers(MotorRegister.MODE, 1) == [PicMode.STOP] * 2
    assert wanderer.ask("A") == ["$"]  # also ends it
    assert wanderer.state.vehicle[WANDERING] == 0
    assert rounds(wanderer) == [0, 0]


def test_the_vehicle_has_rounds_of_20_ms() -> None:
    wanderer = robot()
    wanderer.set_proximity([0] * 11)
    wanderer.ask("A,0", "D,l0,l0")
    wanderer.bus.dspic.time_ms = lambda: 30
    assert rounds(wanderer) == [0, 0]
    wanderer.bus.dspic.time_ms = lambda: 40
    assert rounds(wanderer) == [20 * 256, 20 * 256]


# Published hosts ---------------------------------------------------------------------------------------


def up_to_line_feed(replies: bytes) -> list[str]:
    """Read lines as fscanf of Matlab, ReadLine of C# and readline with strip of Python do."""
    return [line.strip().decode() for line in replies.split(b"\n") if line.strip()]


def up_to_return_less_two(replies: bytes) -> list[str]:
    """Read bytes up to CR, and cut the last two."""
    return [(line + b"\r")[:-2].decode() for line in replies.split(b"\r")[:-1]]


class PublishedHost(NamedTuple):
    """Exchanges of a published program: requests, expected replies, and its way of reading."""

    requests: tuple[bytes, ...]
    replies: tuple[str, ...]
    read: Callable[[bytes], list[str]] = up_to_line_feed
    roms: tuple[str, ...] = (FIRMWARE, SERVER)


NINE = ",".join(map(str, PROXIMITY[1:]))
HOSTS = {
    "line follower, Python over Bluetooth, 2009": PublishedHost(
        (b"B\r", b"M\r", b"K,0,1\r", b"D,l12000,l-12000\r", b"D,l0.0,l3000.5\r", b"N\r"),
        ("b,3,0", "m", "k", "d", "d", f"n,-1,{NINE},0"),
        up_to_return_less_two,
        (FIRMWARE,),  # of kh3server's replies it would cut a character
    ),
    "arrow keys, Python over Bluetooth": PublishedHost((b"D,l10000,l-10000\r\n", b"D,l0,l0\r\n"), ("d", "d")),
    "control in closed loop, Matlab": PublishedHost(
        (b"D,l1234.5678,l-20\n", b"R\n", b"D,l0,l0\n"), ("d", "r,0,0", "d")
    ),
    "evolved controllers, Java": PublishedHost(
        (b"M\n", b"D,l8000,l17500\n\n", b"O\n", b"D,l0,l0\n"), ("m", "d", "o" + ",0" * 12, "d")
    ),
    "reinforcement learning, Python": PublishedHost(
        (b"B\n", b"C,0,d21\n", b"G,3\n", b"D,l20000,l-20000\n"),
        ("b,3,0", "c", f"g,1,27,2900,100000{EMPTY_ECHOES},1800", "d"),
    ),
    "evolution, C#": PublishedHost((b"M\n", b"D,l21500,l43000\n", b"N\n"), ("m", "d", f"n,-1,{NINE},0")),
    "node of ROS": PublishedHost((b"D,0,0\n", b"D,l5000,l-5000\n"), ("d", "d")),
    "the manual's, Matlab": PublishedHost(
        (b"B\n", b"C,0,d31\n", b"C,1,d1\n", b"G,1\n"), ("b,3,0", "c", "c", f"g,0,0,0,0{EMPTY_ECHOES},1800")
    ),
    "the manual's syntax lines": PublishedHost(
        (
            b"C,0,d3\n",
            b"F,l1000,l1000\n",
            b"H,d1,d200,d5,d10\n",
            b"K,0,1\n",
            b"J,d15000,10\n",
            b"P,l1000,l1000\n",
        ),
        ("c", "f", "h", "k", "j", "p"),
    ),
}


@pytest.mark.parametrize(("host", "rom"), [(host, rom) for host in HOSTS.values() for rom in host.roms])
def test_published_hosts_hear_what_they_expect(host: PublishedHost, rom: str) -> None:
    letters = robot(rom).letters
    replies = host.read(b"".join(map(letters.receive, host.requests)))
    expected = [text.replace("n,-1", "n,65535") if rom == SERVER else text for text in host.replies]
    assert replies == expected


@pytest.mark.parametrize("rom", [FIRMWARE, SERVER])
def test_no_bytes_raise_an_error(rom: str) -> None:
    hostile, rng = robot(rom), random.Random(7)
    letters = b"ABCDEFGHIJKLMNOPRVXZ,,,,dl-+.0123456789 \r\n\n\0\xff"
    for number in range(1500):
        hostile.letters.receive(bytes(rng.choices(letters, k=rng.randrange(40))))
        if number % 5 == 0:
            hostile.letters.tick()
    for digits in (b"9" * 1000, b"-" + b"1" * 5000, b"l" * 3000):
        for letter in b"ACDFGHIJKLPV":
            hostile.letters.receive(b"%c,%b,l%b\n" % (letter, digits, digits))
