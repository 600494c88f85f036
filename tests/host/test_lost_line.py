"""Disconnected lines: retries, error messages and durations."""

import os
import signal
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import serial
from served_twin import served

from khep_twin.errors import PortError, PortTimeout, ProtocolError
from khep_twin.host import Khepera, commands
from stand_ins.fake_robot import FakeRobot

# pyserial forgets to close a socket whose other end has gone.
pytestmark = pytest.mark.filterwarnings(
    "ignore:unclosed <socket", "ignore::pytest.PytestUnraisableExceptionWarning"
)

BOUND_S = 8.0
"""Far beyond all documented durations, for machines under load [s]."""


@pytest.fixture
def fake() -> Iterator[FakeRobot]:
    with FakeRobot() as robot:
        yield robot


@pytest.mark.parametrize("url", ["/dev/nope", "khep://nope", "khep://default?seed=x", "socket://127.0.0.1:1"])
def test_a_port_that_is_not_there_is_one_error_without_a_chain_of_others(url: str) -> None:
    with pytest.raises(PortError) as caught:
        Khepera(url)
    lines = "".join(traceback.format_exception(caught.value))
    assert lines.count("Traceback") == 1, lines
    assert str(caught.value).startswith(url)


def test_a_killed_twin_is_one_clear_error() -> None:
    start = 0.0
    with (  # noqa: PT012
        served("default") as (process, path),
        pytest.raises(PortError, match=r"the port failed at .*the motors may still run") as caught,
        Khepera(path) as robot,
    ):
        robot.set_speed(5, 5)
        process.kill()
        process.wait()
        start = time.monotonic()
        while True:
            robot.proximity()
    assert time.monotonic() - start < BOUND_S
    assert "\n" not in str(caught.value)
    assert "its number may be reused by now" in str(caught.value)


def test_the_link_of_a_killed_twin_is_not_followed_to_a_stranger(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    with served("default", "--link", str(link)) as (process, path):
        with pytest.raises(PortError, match="is not opened again"), Khepera(path) as robot:  # noqa: PT012
            robot.set_speed(5, 5)
            process.kill()
            process.wait()
            robot.proximity()


def test_a_link_that_is_served_again_is_reopened(tmp_path: Path) -> None:
    link = str(tmp_path / "khepera")
    with ExitStack() as stack:
        process, _ = stack.enter_context(served("default", "--link", link))

        def cut() -> None:
            with Khepera(link) as robot:
                process.kill()
                process.wait()
                stack.enter_context(served("default", "--link", link))
                robot.proximity()

        with pytest.raises(PortError, match="the port was opened again and the motors were stopped"):
            cut()


def test_a_robot_that_comes_back_is_stopped(fake: FakeRobot) -> None:
    def cut() -> None:
        with Khepera(fake.url) as robot:
            robot.set_speed(5, 5)
            fake.disconnect()
            robot.proximity()

    with pytest.raises(PortError, match=r"port failed .*; the port was opened again and the motors were"):
        cut()
    assert fake.requests[-1] == "D,0,0"


def test_a_peer_that_is_gone_is_reported_once(fake: FakeRobot) -> None:
    def cut() -> None:
        with Khepera(fake.url) as robot:
            fake.disconnect(for_good=True)
            robot.proximity()

    start = time.monotonic()
    with pytest.raises(PortError, match=r"port failed .*motors may still run.*again failed: .*refused"):
        cut()
    assert time.monotonic() - start < BOUND_S


def test_a_host_that_fails_itself_keeps_its_own_error(fake: FakeRobot) -> None:
    def fail() -> None:
        with Khepera(fake.url):
            fake.disconnect(for_good=True)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as caught:
        fail()
    assert "the motors may still run" in caught.value.__notes__[0]


def test_motors_that_cannot_be_stopped_are_reported_at_the_end(fake: FakeRobot) -> None:
    with pytest.raises(PortError, match="the motors may still run"), Khepera(fake.url, 0.5):
        fake.silent = True


def test_a_silent_robot_ends_within_the_timeout(fake: FakeRobot) -> None:
    with Khepera(fake.url, timeout=0.4) as robot:
        fake.silent = True
        start = time.monotonic()
        with pytest.raises(PortTimeout, match=r"no reply to 'N' within [0-9.]+ s; is the robot on"):
            robot.proximity()
        assert time.monotonic() - start >= 0.4
        # One try for the reply and one probe, and no more.
        assert fake.requests == ["N", "B"]
        fake.silent = False
        assert robot.position() == (12, -5)


def test_baud_rates_without_a_reply_are_all_reported(fake: FakeRobot) -> None:
    fake.silent = True
    with pytest.raises(PortTimeout, match="no answer to 'B' at 9600, 19200, 38400, 57600, 115200 baud"):
        Khepera(fake.url, baudrate="auto")


def test_a_stopped_twin_does_not_hold_up_its_host() -> None:
    with served("default") as (process, path):
        robot = Khepera(path, timeout=0.6)
        os.kill(process.pid, signal.SIGSTOP)
        start = time.monotonic()
        with pytest.raises(PortTimeout):
            robot.burst(*[commands.proximity()] * 7)
        # Nobody reads: the output fills the buffer until a write times out.
        with pytest.raises((PortTimeout, serial.SerialTimeoutException)):  # noqa: PT012
            while True:
                robot.port.write(b"N\n" * 1000)
                robot.proximity()
        robot.close()
        assert time.monotonic() - start < BOUND_S


def test_a_read_is_asked_again_and_an_order_is_not(fake: FakeRobot) -> None:
    with Khepera(fake.url) as robot:
        fake.prefix = b"\x80\x81n,1,2"
        assert robot.proximity().back_left == 1023
        assert fake.requests == ["N", "B", "N"]
        fake.requests.clear()
        fake.answers["D"] = "x"
        with pytest.raises(ProtocolError, match="'D,5,5' was answered 'x'; expected 'd' alone"):
            robot.set_speed(5, 5)
        assert fake.requests == ["D,5,5", "B"]
        del fake.answers["D"]


def test_an_order_whose_answer_comes_behind_noise_is_done(fake: FakeRobot) -> None:
    with Khepera(fake.url) as robot:
        fake.prefix = b"Command not found\r\nrubbish\r\n"
        robot.set_target(100, 100)
        assert fake.requests == ["C,100,100", "B"]
        assert robot.position() == (12, -5)


class StalledPort(serial.SerialBase):
    """A port in simulated time that replies to nothing until a time, and then to all requests."""

    name, baudrate, timeout, time_ns, is_open = "stalled", 9600, 0.5, 0, True

    def __init__(self, until_ns: int) -> None:
        self._until_ns, self._lines, self._count = until_ns, list[bytes](), 0

    def write(self, data: bytes) -> int:
        for request in data.split():
            self._count += 1
            reads = {b"B": b"b,5.02,5.01", b"H": b"h,%d,0" % self._count, b"E": b"e,0,0", b"K": b"k,1,1"}
            reply = reads.get(request[:1], request[:1].lower())
            self._lines.append(reply + b"\r\n")
        return len(data)

    def read_until(self, expected: bytes = b"\n", size: int | None = None) -> bytes:
        if self.time_ns < self._until_ns or not self._lines:
            self.time_ns += 500_000_000
        return self._lines.pop(0) if self.time_ns >= self._until_ns and self._lines else b""

    def close(self) -> None:
        self._lines.clear()


@pytest.mark.filterwarnings("ignore:stalled. the reply to 'H' took:UserWarning")
@pytest.mark.parametrize("until_s", [0.5, 1.0, 2.0, 2.5, 3.0, 10.0])
def test_answers_that_come_late_are_never_taken_for_new_ones(until_s: float) -> None:
    port = StalledPort(round(until_s * 1e9))
    with Khepera(port) as robot:
        while True:
            try:
                robot.position()
                break
            except PortTimeout:
                assert port.time_ns < (until_s + 2) * 1e9
        for _ in range(3):
            assert robot.position() == (port._count, 0)


@pytest.mark.parametrize("until_s", [1.0, 2.0, 4.5])
def test_an_order_whose_answer_comes_late_is_done_and_the_delay_reported_once(until_s: float) -> None:
    port = StalledPort(round(until_s * 1e9))
    with Khepera(port) as robot:
        with pytest.warns(
            UserWarning, match=f"stalled: the reply to 'D,5,5' took {until_s} s; expected at"
        ) as caught:
            robot.set_speed(5, 5)
        port._until_ns = port.time_ns + 1_500_000_000
        robot.set_speed(6, 6)
        assert robot.position() == (port._count, 0)
    assert len(caught) == 1


def test_any_line_whose_answer_comes_late_has_it() -> None:
    port = StalledPort(2_000_000_000)
    with Khepera(port) as robot, pytest.warns(UserWarning, match="the reply to 'I,1' took 2.0 s"):
        assert robot.ask("I,1") == "i"


def test_a_silent_robot_is_reported_after_five_seconds_with_the_line_that_was_sent() -> None:
    port = StalledPort(10**12)
    robot = Khepera(port)
    with pytest.raises(PortTimeout, match=r"no reply to 'D,5,5' within 5 s; is the robot on"):
        robot.set_speed(5, 5)
    assert port.time_ns == 5_000_000_000
    assert port._count <= 6


def test_a_final_stop_that_is_confirmed_late_is_no_error() -> None:
    port = StalledPort(0)
    with Khepera(port) as robot:
        robot.set_speed(5, 5)
        port._until_ns = port.time_ns + 2_000_000_000


def test_a_mode_that_no_rom_has_is_refused(fake: FakeRobot) -> None:
    fake.answers["K"] = "k,1,7,0,1,1,0"
    with Khepera(fake.url) as robot, pytest.raises(ProtocolError, match="expected a mode of 0, 1, 2"):
        robot.status()


def test_the_modes_of_rom_4_are_read_the_other_way_round(fake: FakeRobot) -> None:
    fake.answers |= {"B": "b,4.06,4.06", "K": "k,0,0,3,0,1,4"}
    with Khepera(fake.url) as robot:
        assert [wheel.mode.name for wheel in robot.status()] == ["POSITION", "SPEED"]
        robot.status()
        assert fake.requests.count("B") == 1
