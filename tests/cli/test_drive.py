"""`khep-twin drive` in a pseudo-terminal: keys in, screens out, and the robot stops at any end."""

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from forked import run_python
from scheduling_delay import SchedulingDelay

from khep_twin.lab.experiment.teleoperation import FIRST_HOLD
from khep_twin.log.reader import read_log
from stand_ins.fake_robot import FakeRobot

LONG = 60.0
"""Far more than anything here takes [s]."""


MOST_LATE = 0.05
"""Scheduling delay with which keys are still seen as held or released [s]."""


class Terminal:
    """A terminal with `khep-twin drive` in it."""

    def __init__(self, *arguments: str, size: tuple[int, int] = (24, 80), kind: str = "xterm") -> None:
        self.descriptor, self._terminal_end = pty.openpty()
        fcntl.ioctl(self._terminal_end, termios.TIOCSWINSZ, struct.pack("HHHH", *size, 0, 0))
        self.before = termios.tcgetattr(self._terminal_end)
        self.text = ""
        self.late = SchedulingDelay()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "khep_twin", "drive", *arguments],
            stdin=self._terminal_end,
            stdout=self._terminal_end,
            stderr=self._terminal_end,
            env={**os.environ, "TERM": kind, "LINES": "", "COLUMNS": ""},
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )

    def type(self, keys: bytes) -> None:
        """Presses keys."""
        os.write(self.descriptor, keys)

    def wait_for(self, pattern: str, *, holds_key: bool = False) -> None:
        """Read the screen until new text matches; `holds_key` if only while a key is held."""
        end = time.monotonic() + LONG
        while not re.search(pattern, self.text):
            if time.monotonic() > end:
                if holds_key:
                    self.late.excuse(MOST_LATE)
                raise AssertionError(f"no {pattern!r} in {self.text!r}")
            if select.select([self.descriptor], [], [], 0.1)[0]:
                self.text += os.read(self.descriptor, 65536).decode("ascii")
        self.text = ""

    def end(self) -> int:
        """Reads on until it has ended; returns its exit code."""
        end = time.monotonic() + LONG
        while self.process.poll() is None:
            assert time.monotonic() < end, f"it goes on: {self.text!r}"
            if select.select([self.descriptor], [], [], 0.05)[0]:
                self.text += os.read(self.descriptor, 65536).decode("ascii")
        while select.select([self.descriptor], [], [], 0)[0]:
            self.text += os.read(self.descriptor, 65536).decode("ascii")
        return self.process.returncode

    def restored(self) -> bool:
        """Return whether settings and screen of the terminal are restored."""
        return termios.tcgetattr(self._terminal_end) == self.before and "\x1b[?1049l" in self.text

    def hang_up(self) -> None:
        """Closes the terminal's window."""
        os.close(self._terminal_end)
        os.close(self.descriptor)
        self._terminal_end = self.descriptor = -1

    def close(self) -> None:
        """Ends it all."""
        self.late.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        if self.descriptor >= 0:
            self.hang_up()


@pytest.fixture
def fake() -> Iterator[FakeRobot]:
    with FakeRobot() as robot:
        yield robot


@pytest.fixture
def terminal(fake: FakeRobot) -> Iterator[Terminal]:
    window = Terminal(fake.url)
    yield window
    window.close()


def orders(fake: FakeRobot) -> list[str]:
    """The speeds that were sent, each once."""
    speeds = [request for request in fake.requests if request.startswith("D")]
    return [speed for index, speed in enumerate(speeds) if index == 0 or speed != speeds[index - 1]]


def test_keys_drive_and_the_sensors_are_on_the_screen(fake: FakeRobot, terminal: Terminal) -> None:
    terminal.wait_for(r"back left .*#+ 1023")
    for keys, display in (
        (b"w", "forward"),
        (b"\x1b[B", "back"),
        (b"A", "left"),
        (b"\x1bOC", "right"),
        (b" ", "stop"),
        (b"9w", "forward, speed 9"),
        (b"+", "10"),
    ):
        terminal.type(keys)
        terminal.wait_for(display, holds_key=True)
    terminal.type(b"l")
    # Of "off" only a letter changes on the screen, unless a key is released in the same moment.
    terminal.wait_for("n ", holds_key=True)
    terminal.type(b"q")
    assert terminal.end() == 0
    assert terminal.restored()
    assert "the motors were stopped" in terminal.text
    terminal.late.excuse(MOST_LATE)
    # Whether `w` was still driving when the speed went to 10 is a matter of time.
    assert [order for order in orders(fake) if order != "D,10,10"] == [
        *("D,0,0", "D,5,5", "D,-5,-5", "D,-3,3", "D,3,-3", "D,0,0", "D,9,9", "D,0,0")
    ]
    assert "L,0,1" in fake.requests


def test_a_key_that_is_released_stops_the_robot(fake: FakeRobot, terminal: Terminal) -> None:
    terminal.wait_for("stop, speed 5")
    for _ in range(10):
        terminal.type(b"w")
        time.sleep(0.03)
    terminal.wait_for("forward", holds_key=True)
    terminal.wait_for("stop")
    terminal.late.excuse(MOST_LATE)
    assert orders(fake) == ["D,0,0", "D,5,5", "D,0,0"]


@pytest.mark.share(4)
@pytest.mark.parametrize("how", ["ctrl-c", "SIGTERM", "ctrl-z", "SIGINT", "SIGHUP"])
def test_whatever_ends_it_the_motors_stop_and_the_terminal_is_as_it_was(
    fake: FakeRobot, terminal: Terminal, how: str
) -> None:
    terminal.wait_for("stop, speed 5")
    terminal.type(b"w")
    terminal.wait_for("forward", holds_key=True)
    if how == "ctrl-z":
        # It is no way to leave a robot alone: nothing happens.
        terminal.type(b"\x1a")
        terminal.wait_for("stop")
        terminal.type(b"q")
    elif how == "ctrl-c":
        terminal.type(b"\x03")
    else:
        terminal.process.send_signal(getattr(signal, how))
    assert terminal.end() == (128 + getattr(signal, how) if how.startswith("SIG") else 0)
    assert terminal.restored()
    assert fake.requests[-1] == "D,0,0"


def test_a_terminal_that_closes_stops_the_robot(fake: FakeRobot, terminal: Terminal) -> None:
    terminal.wait_for("stop, speed 5")
    terminal.type(b"w")
    terminal.wait_for("forward", holds_key=True)
    terminal.hang_up()
    terminal.process.wait(LONG)
    assert fake.requests[-1] == "D,0,0"


def test_a_screen_that_hangs_does_not_keep_the_robot_driving(fake: FakeRobot, terminal: Terminal) -> None:
    terminal.wait_for("stop, speed 5")
    terminal.type(b"w")
    end = time.monotonic() + LONG
    # Nobody reads the screen from here on: a network that is gone.
    while orders(fake) != ["D,0,0", "D,5,5", "D,0,0"]:
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_lost_line_is_reported_when_the_terminal_is_back(fake: FakeRobot, terminal: Terminal) -> None:
    terminal.wait_for("stop, speed 5")
    fake.disconnect(for_good=True)
    assert terminal.end() == 1
    assert terminal.restored()
    output = terminal.text.split("\x1b[?1049l")[1]
    assert re.search(r"khep-twin: socket://\S+ the port failed at .*the motors may still run", output)
    assert "Traceback" not in output


def test_a_small_terminal_says_how_large_it_must_be(fake: FakeRobot) -> None:
    window = Terminal(fake.url, size=(10, 70))
    try:
        window.wait_for("70 x 10 characters; expected at least 64 x 18; q ends")
        window.type(b"q")
        assert window.end() == 0
    finally:
        window.close()


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        (["{url}"], "nonsense", "TERM=nonsense: this terminal cannot be drawn on .*expected TERM=xterm"),
        (["{url}", "--log", "a.mcap"], "xterm", r"expected serve --log, or serve --relay socket://"),
        (["khep://nowhere"], "xterm", "nowhere: no such file"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    fake: FakeRobot, arguments: list[str], kind: str, message: str
) -> None:
    window = Terminal(*[argument.format(url=fake.url) for argument in arguments], kind=kind)
    try:
        assert window.end() == 1
        assert re.search(message, window.text)
        assert "Traceback" not in window.text
    finally:
        window.close()


def test_a_drive_on_a_twin_in_this_process_takes_its_time_and_is_logged(tmp_path: Path) -> None:
    log = tmp_path / "a drive.mcap"
    window = Terminal("khep://default?noise=off", "--log", str(log))
    try:
        window.wait_for("stop, speed 5")
        window.type(b"w")
        window.wait_for("forward", holds_key=True)
        window.wait_for("stop")
        window.type(b"q")
        assert window.end() == 0
        assert f"log      {log}" in window.text
    finally:
        window.close()
    track = read_log(log).robots["khepera0"]
    window.late.excuse(MOST_LATE)
    # One press at 40 mm/s, for as long on the robot's clock as on the wall's.
    direction = abs(track.pose[-1, :2] - track.pose[0, :2]).sum()
    assert 0.5 * FIRST_HOLD * 0.04 < direction < 4 * FIRST_HOLD * 0.04


def test_without_a_terminal_it_says_so(fake: FakeRobot) -> None:
    command = [sys.executable, "-m", "khep_twin", "drive", fake.url]
    result = run_python(command, stdin=subprocess.DEVNULL)
    assert result.returncode == 1
    assert "there is no terminal to drive from" in result.stderr
