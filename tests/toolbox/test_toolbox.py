"""The toolbox's commands: the requests that they send, and their return values."""

import subprocess
import sys
from io import BytesIO
from typing import cast

import numpy as np
import pytest
from scipy.io import loadmat, savemat
from serial.serialutil import SerialBase

from khep_twin.errors import PortError, ProtocolError
from khep_twin.host import Khepera
from khep_twin.toolbox import serial_commands

REPLIES = {
    "E": "e,-3,12",
    "H": "h,-1250,2147483647",
    "I": "i,625",
    "K": "k,1,0,-2,0,1,7",
    "N": "n,1,2,3,4,5,6,7,1023",
    "O": "o,500,499,498,497,496,495,494,50",
    "B": "b,5.02,5.01",
}


class Listener:
    """A port that records requests and replies as in the manual."""

    name, baudrate, timeout, write_timeout, is_open = "listener", 9600, 0.5, 0.5, True

    def __init__(self) -> None:
        self.sent: list[str] = []
        self._answers: list[bytes] = []

    def write(self, data: bytes) -> int:
        """Record each request, except that for the ROM's version, and prepare the reply."""
        for request in data.decode("ascii").split():
            if request != "B":
                self.sent.append(request)
            self._answers.append(REPLIES.get(request[0], request[0].lower()).encode("ascii") + b"\r\n")
        return len(data)

    def read_until(self, expected: bytes, size: int | None) -> bytes:
        """Return the next reply."""
        return self._answers.pop(0) if self._answers else b""

    def close(self) -> None:
        """Mark the port as closed."""
        self.is_open = False


@pytest.fixture
def line() -> Listener:
    port = Listener()
    serial_commands.ports({2: Khepera(cast(SerialBase, port))})
    return port


def test_commands_take_the_toolboxs_arguments_in_the_toolboxs_order(line: Listener) -> None:
    serial_commands.con(2, 3800, 800, 100)
    serial_commands.skp(2, 100, -200)
    serial_commands.sms(2, 5, -6)
    serial_commands.cpid(2, 3000, 20, 4000)
    serial_commands.spc(2, 7, 8)
    serial_commands.cspc(2, 20, 64, 21, 65)
    serial_commands.cls(2, 1, 2)
    serial_commands.rad(2, 3)
    for name in ("rms", "rpc", "rmc", "rps", "rls"):
        getattr(serial_commands, name)(2)
    orders = "A,3800,800,100 C,100,-200 D,5,-6 F,3000,20,4000 G,7,8 J,20,64,21,65 L,1,2 I,3"
    assert line.sent == [*orders.split(), *"EHKNO"]


def test_rows_have_the_toolboxs_numbers_in_the_toolboxs_order(line: Listener) -> None:
    assert serial_commands.rms(2).tolist() == [-3, 12]
    assert serial_commands.rpc(2).tolist() == [-1250, 2147483647]
    assert serial_commands.rmc(2).tolist() == [1, 0, -2, 0, 1, 7]
    assert serial_commands.rps(2).tolist() == [1, 2, 3, 4, 5, 6, 7, 1023]
    assert serial_commands.rls(2).tolist() == [500, 499, 498, 497, 496, 495, 494, 50]
    assert serial_commands.rad(2, 0) == 625


def test_a_row_comes_to_matlab_as_1_by_8(line: Listener) -> None:
    file = BytesIO()
    savemat(file, {"a": serial_commands.rps(2), "b": serial_commands.rpc(2), "c": serial_commands.rmc(2)})
    assert [loadmat(file)[name].shape for name in "abc"] == [(1, 8), (1, 2), (1, 6)]


@pytest.mark.parametrize(
    ("speed", "sent"),
    [(0.5, 1), (-0.5, -1), (2.5, 3), (-2.5, -3), (3.4999, 3), (-0.49999999999999994, 0), (np.float64(7), 7)],
)
def test_a_fractional_speed_is_rounded_half_away_from_zero(line: Listener, speed: float, sent: int) -> None:
    serial_commands.sms(2, speed, 0)
    assert line.sent == [f"D,{sent},0"]


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), 1e12, 10**400])
def test_what_is_no_speed_is_not_sent(line: Listener, wrong: float) -> None:
    with pytest.raises(ValueError, match=r"sms: speed_right = .*; expected a number"):
        serial_commands.sms(2, 0, wrong)
    assert line.sent == []


def test_a_port_is_a_number_that_was_given_a_url_or_the_environments_or_a_url(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    url = "khep://default?noise=off"
    monkeypatch.setenv("KHEP_PORT_3", url + "&seed=3")
    serial_commands.ports({1: url})
    serial_commands.spc(1, 10, 10)
    serial_commands.spc(3, 30, 30)
    serial_commands.spc(url + "&seed=5", 50, 50)
    assert [serial_commands.rpc(port)[0] for port in (1, 3, url + "&seed=5", url)] == [10, 30, 50, 10]
    first = serial_commands.robot_at(1)
    serial_commands.ports({})
    assert not first.port.is_open


def test_a_port_that_was_not_assigned_says_what_to_do() -> None:
    with pytest.raises(PortError, match=r"4: no port is chosen; expected ports\({4: .*KHEP_PORT_4="):
        serial_commands.rps(4)
    with pytest.raises(PortError, match="port_id = 5; expected 1 to 4"):
        serial_commands.rps(5)
    with pytest.raises(PortError, match="ports: 0; expected a number from 1 to 4"):
        serial_commands.ports({0: "khep://default"})


def test_the_numbers_of_a_twin_are_those_of_its_board() -> None:
    with Khepera("khep://default?noise=off") as robot:
        serial_commands.cspc(robot, 10, 20, 10, 20)
        serial_commands.cls(robot, 0, 1)
        serial_commands.skp(robot, 125, 125)
        robot.sleep(3)
        assert serial_commands.rmc(robot)[[0, 1, 3, 4]].tolist() == [1, 1, 1, 1]
        assert np.abs(serial_commands.rpc(robot) - 125).max() <= 2
        # 5 cm/4 at 12.5 pulses to a millimetre.
        assert robot.port.twin.robot.pose[1] == pytest.approx(0.25 + 125 * 80e-6, abs=5e-4)
        assert 0 < serial_commands.rad(robot, 0) < 1024


def test_a_program_that_ends_stops_its_robot() -> None:
    program = (
        "from khep_twin.toolbox.serial_commands import *\nimport atexit\n"
        "robot = robot_at('khep://default')\ntwin = robot.port.twin\n"
        "sms('khep://default', 9, 9)\natexit._run_exitfuncs()\n"
        "print(robot.port.is_open, twin.robot.registers[4])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "False 0\n"


def test_the_commands_load_no_simulator() -> None:
    program = (
        "import sys, khep_twin.toolbox.serial_commands; "
        "print([m for m in ('mujoco', 'rerun', 'matplotlib', 'scipy', 'pydantic') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


def test_a_turret_is_asked_by_its_number() -> None:
    with Khepera("khep://gripper?noise=off") as robot:
        assert serial_commands.kturret(robot, 1, "B").tolist() == [1, 0]
        assert serial_commands.kturret(robot, 1.0, "H,0").tolist() == [200]
        assert serial_commands.kturret(robot, 1, "D,1").tolist() == []


@pytest.mark.parametrize(
    ("turret", "message", "answer"),
    [
        (2, "N", "Turret order not supported"),
        (1, "X", "Turret order not supported"),
        (1, "H,7", "Protocol error"),
    ],
)
def test_what_no_turret_answers_is_an_error(turret: int, message: str, answer: str) -> None:
    with Khepera("khep://gripper") as robot, pytest.raises(ProtocolError, match=answer):
        serial_commands.kturret(robot, turret, message)
