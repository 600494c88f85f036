"""The host library, on a twin in lock-step and on faulty ports."""

import math
import subprocess
import sys
import traceback
from pathlib import Path
from typing import Any

import pytest
import serial

from khep_twin.errors import MoveError, PortError, PortTimeout, ProtocolError, StoppedError
from khep_twin.host import Khepera
from khep_twin.ports.port_users import port_user


@pytest.fixture
def robot() -> Any:
    with Khepera("khep://default?noise=off") as khepera:
        yield khepera


def test_every_command_has_its_method(robot: Khepera) -> None:
    robot.configure_speed_controller(3800, 800, 100)
    assert robot.versions() == ("5.02", "5.01")
    robot.configure_position_controller(3000, 20, 4000)
    robot.configure_profile(20, 64, 20, 64)
    robot.set_led(0, 1)
    assert robot.proximity() == (0,) * 8
    assert robot.ambient() == (485,) * 8
    assert robot.converter(2) == 485
    assert robot.read_bus(3) == 255
    robot.write_bus(1, 2)
    robot.set_position(100, -100)
    assert robot.position() == (100, -100)
    robot.set_duty(20, 20)
    robot.set_speed(5, -5)
    robot.sleep(0.5)
    assert robot.speed() == pytest.approx((5, -5), abs=2)
    left, right = robot.status()
    assert (left.on_target, left.mode, right.mode) == (False, 0, 0)
    robot.set_target(100, -100)
    robot.sleep(3)
    assert robot.status()[0].on_target
    assert robot.position() == pytest.approx((100, -100), abs=2)
    with pytest.raises(ProtocolError, match="'T,1,B' was answered 'z,Turret order not supported'"):
        robot.turret(1, "B")


def test_time_is_that_of_the_port(robot: Khepera) -> None:
    start = robot.time
    robot.sleep(2.5)
    assert robot.time - start == pytest.approx(2.5)


def test_closing_stops_the_motors() -> None:
    robot = Khepera("khep://default")
    twin = robot.port.twin
    with robot:
        robot.set_speed(10, 10)
    assert twin.robot.registers[[4, 18]].tolist() == [0, 0]
    assert not robot.port.is_open
    robot.close()


def test_after_a_broken_exchange_the_next_one_is_right(robot: Khepera) -> None:
    robot.set_position(5, 6)
    robot.port.timeout = 0.01
    with pytest.raises(PortTimeout):
        robot.proximity()
    robot.port.timeout = 1.0
    assert robot.position() == (5, 6)


def test_a_stop_ignores_the_reply_to_an_interrupted_command() -> None:
    robot = Khepera("khep://default")
    twin = robot.port.twin
    robot.set_speed(10, 10)
    write = robot.port.write

    def interrupted(data: bytes) -> None:
        write(data)
        raise KeyboardInterrupt

    robot.port.write = interrupted
    with pytest.raises(KeyboardInterrupt):
        robot.set_speed(5, 5)
    del robot.port.write
    robot.hold()
    assert twin.robot.registers[[4, 18]].tolist() == [0, 0]
    robot.close()


@pytest.mark.parametrize("tool", ["help", "list", "restart"])
def test_the_rest_of_a_tools_output_is_no_reply_to_the_next_request(tool: str) -> None:
    with Khepera("khep://default?noise=off") as robot:
        robot.ask(tool)
        assert robot.ask("B") == "b,5.02,5.01"


def test_a_request_of_two_lines_and_an_odd_number_of_retries_are_refused(robot: Khepera) -> None:
    with pytest.raises(ValueError, match="expected one line of ASCII"):
        robot.ask("B\nH")
    for retries in (-1, 0.5):
        with pytest.raises(ValueError, match="expected an integer from 0"):
            Khepera("khep://default", retries=retries)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "options", [{"timeout": math.nan}, {"timeout": -1.0}, {"timeout": math.inf}, {"wheel_base": 0.0}]
)
def test_durations_and_distances_that_cannot_be_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"expected a (finite )?number"):
        Khepera("khep://default", **options)


def test_a_port_may_be_a_path_and_an_odd_one_is_one_error(tmp_path: Path) -> None:
    for url in (tmp_path / "none", "hwgrep://("):
        with pytest.raises(PortError):
            Khepera(url)
    assert port_user("socket://[::1") == ""


def test_a_wait_until_nan_ends_immediately(robot: Khepera) -> None:
    robot.set_target(1000, 1000)
    with pytest.raises(MoveError, match="not on target"):
        robot.wait_for_target(math.nan)


@pytest.mark.parametrize("reply", ["h,1_0,5", "h," + "9" * 30 + ",5", "h,+1,5"])
def test_what_is_no_integer_of_the_robots_is_a_protocol_error(reply: str) -> None:
    with pytest.raises(ProtocolError, match="expected integers"):
        Khepera(Silent(f"{reply}\r\n".encode()), retries=0).position()


@pytest.mark.parametrize("request_line", [" D,20,20", "P,1,1", "run demo"])
def test_a_robot_that_must_stand_still_is_not_moved_by_any_line(robot: Khepera, request_line: str) -> None:
    robot.hold()
    with pytest.raises(StoppedError, match="is not sent"):
        robot.ask(request_line)


def test_reads_get_through_a_line_that_loses_bytes() -> None:
    with Khepera("khep://default?noise=off&seed=3&fault=drop:0.003@0.1", retries=4) as robot:
        robot.sleep(0.2)
        assert {robot.proximity()[2] for _ in range(200)} == {0}


class Silent(serial.SerialBase):
    """A port whose robot answers with fixed bytes, or not at all."""

    def __init__(self, answer: bytes) -> None:
        super().__init__(timeout=0.25)
        self.answer = answer
        self.name = "silent"
        self.is_open = True

    def _reconfigure_port(self) -> None: ...

    def write(self, data: Any, /) -> int:
        return len(data)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        return self.answer

    def close(self) -> None:
        self.is_open = False


def test_silence_is_a_clear_error() -> None:
    with pytest.raises(PortTimeout, match=r"silent: no reply to 'N' within 0.25 s; is the robot on"):
        Khepera(Silent(b"")).proximity()
    with pytest.raises(PortTimeout, match="only 'n,1,2'"):
        Khepera(Silent(b"n,1,2")).proximity()


@pytest.mark.share(2)
@pytest.mark.parametrize(
    "answer", [b"n,1,2\r\n", b"o,1,2,3,4,5,6,7,8\r\n", b"n,1,2,3,4,5,6,7,x\r\n", b"Command not found\r\n"]
)
def test_a_wrong_answer_is_reported_with_the_exchange(answer: bytes) -> None:
    with pytest.raises(ProtocolError) as caught:
        Khepera(Silent(answer)).proximity()
    assert "N" in str(caught.value)
    assert answer.decode().strip() in str(caught.value)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "/dev/no-such-port",
            "^/dev/no-such-port: cannot open this port: No such file or directory; .*khep-twin ports. lists",
        ),
        ("obstacles", "^obstacles: no port; expected khep://obstacles for a twin in it$"),
        ("khep://nowhere", "khep://nowhere: nowhere: no such file"),
        ("nonsense://x", "nonsense://x: .*not known"),
        ("socket://localhost", "^socket://localhost: expected socket://HOST:PORT, such as"),
        ("rfc2217://localhost:99999", "^rfc2217://localhost:99999: expected rfc2217://HOST:PORT"),
        ("loop://?logging=foo", r"^loop://\?logging=foo: 'foo'"),
    ],
)
def test_a_port_that_cannot_be_opened_is_reported_with_the_expected_form(url: str, message: str) -> None:
    with pytest.raises(PortError, match=message) as caught:
        Khepera(url)
    assert len(traceback.extract_tb(caught.value.__traceback__)) == 3  # with the class and its base


def test_the_host_loads_no_simulator() -> None:
    program = (
        "import sys, khep_twin.host, khep_twin.host.discovery, khep_twin.lab.experiment.teleoperation; "
        "print([m for m in ('mujoco', 'rerun', 'matplotlib', 'numpy', 'pydantic') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
