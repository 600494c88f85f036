"""`serve --relay`: transparent forwarding between host and robot, and a log of both."""

import os
import select
import signal
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from served_twin import ask, connected, served, stop

from khep_twin.host import Khepera3
from khep_twin.log.reader import read_log
from khep_twin.log.viewer.replay import view
from khep_twin.ports import idle_polls
from khep_twin.ports import relay as relaying
from khep_twin.ports.idle_polls import IdlePolls
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.relay import Device
from stand_ins.echoes import loopback


def test_both_directions_are_passed_on_and_logged_as_a_twins_are(tmp_path: Path) -> None:
    log = tmp_path / "robot.mcap"
    requests = [b"B\n", b"N\n", b"D,3,-4\n", b"E\n", b"O\n", b"hello\r"]
    with served("default", "--noise", "off") as (_, robot):
        arguments = ("--relay", robot, "--log", str(log), "--link", str(tmp_path / "khepera"))
        with served(*arguments) as (process, path):
            assert path == str(tmp_path / "khepera")
            with serial.Serial(path, 9600, stopbits=2, timeout=10) as port:
                replies = []
                for request in requests:
                    port.write(request)
                    replies.append(port.readline())
            code, errors = stop(process)
    assert code == 0
    assert "s served" in errors
    assert replies[0] == b"b,5.02,5.01\r\n"
    run = read_log(log)
    assert run.metadata["relay"] == robot
    track = run.robots["khepera0"]
    transcript = [(line.name, line.text.encode()) for line in track.serial]
    assert transcript == [
        entry
        for request, reply in zip(requests, replies, strict=True)
        for entry in (("host", request.strip()), ("robot", reply.strip()))
    ]
    times = [line.time_ns for line in track.serial]
    assert times == sorted(times)
    # The robot's readings are in the same channels as in a twin's log.
    assert track.proximity.tolist() == [numbers(replies[1])]
    assert track.speed.tolist() == [[*numbers(replies[3]), 3, -4]]
    assert track.ambient.tolist() == [numbers(replies[4])]
    view([log], tmp_path / "robot.rrd")
    assert (tmp_path / "robot.rrd").stat().st_size > 1000


def numbers(reply: bytes) -> list[int]:
    return [int(field) for field in reply.strip().split(b",")[1:]]


def test_the_line_follows_the_speed_that_the_host_sets(tmp_path: Path) -> None:
    log = tmp_path / "robot.mcap"
    with (
        served("default", "--mode", "3", "--strict-line") as (_, robot),
        served("--relay", robot, "--log", str(log)) as (process, path),
    ):
        with serial.Serial(path, 38400, stopbits=2, timeout=10) as port:
            assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
        _, errors = stop(process)
    assert "the line is at 38400 baud with 2 stop bits" in errors
    assert ["38400" in line.text for line in read_log(log).events] == [True]


def test_a_relay_of_another_model_has_its_speed_and_logs_its_readings(tmp_path: Path) -> None:
    arguments = ("--model", "khepera3", "--log", str(tmp_path / "robot.mcap"))
    with served("arena3") as (_, robot), served("--relay", robot, *arguments) as (process, path):
        with Khepera3(path) as host:
            assert len(host.proximity()) == 11
        stop(process)
    run = read_log(tmp_path / "robot.mcap")
    assert run.metadata["baud"] == "115200"
    assert run.robots["khepera0"].model.name == "khepera3"
    assert run.robots["khepera0"].proximity.shape == (1, 11)


def test_a_host_that_left_leaves_nothing_to_the_next() -> None:
    with served("default") as (_, robot), served("--relay", robot) as (_, path):
        with serial.Serial(path, 9600, stopbits=2) as port:
            port.write(b"N\n" * 5)
        time.sleep(0.5)
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        os.write(descriptor, b"B\n")
        time.sleep(0.2)
        assert os.read(descriptor, 100) == b"b,5.02,5.01\r\n"
        os.close(descriptor)


@contextmanager
def clocked_line(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, Device, list[float]]]:
    """A robot's end of a line, the relay's port at the other end, and the time of the relay's clock."""
    robot, device = os.openpty()
    tty.setraw(device)
    time_s = [0.0]
    monkeypatch.setattr(relaying, "time", SimpleNamespace(monotonic=lambda: time_s[0]))
    yield robot, Device(os.ttyname(device), 9600), time_s
    os.close(robot)
    os.close(device)


def opened(port: PtyPort) -> int:
    return os.open(port.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


def read_available(descriptor: int) -> bytes:
    """Return the bytes that are available."""
    return os.read(descriptor, 100) if select.select([descriptor], [], [], 0)[0] else b""


@pytest.mark.parametrize("until_s", [1.0, 9.0])
def test_a_new_relay_gives_no_host_the_replies_to_an_earlier_one_but_what_a_robot_says_by_itself(
    until_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands, replies = b"", b""
    with clocked_line(monkeypatch) as (robot, device, time_s), PtyPort() as port:
        host = opened(port)
        os.write(host, b"B\n")

        def step() -> bool:
            nonlocal commands, replies
            time_s[0] += 0.01
            if time_s[0] < until_s:
                os.write(robot, b".")
            if data := read_available(robot):
                commands += data
                os.write(robot, b"b")
            replies += read_available(host)
            return time_s[0] > 3

        relaying.relay(device, port, stop=step, notify=print)
        os.close(host)
    assert commands == b"B\n"
    assert replies.strip(b".") == b"b"
    assert (b"." in replies) == (until_s > relaying._STARTUP_S)


def test_a_relay_that_is_held_up_takes_no_late_reply_for_the_next_hosts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands, replies = b"", b""
    with clocked_line(monkeypatch) as (robot, device, time_s), PtyPort() as port:
        host = opened(port)
        os.write(host, b"N\n")

        left_s: list[float] = []

        def step() -> bool:
            nonlocal commands, replies, host
            time_s[0] += 0.1
            if data := read_available(robot):
                commands += data
                if b"N" in data:
                    os.close(host)
                    host = opened(port)
                    os.write(host, b"B\n")
                    left_s.append(time_s[0])
                else:
                    os.write(robot, b"b\r\n")
            if left_s and time_s[0] - left_s[-1] > 0.15:
                # Held up while the reply to the host that has left comes.
                left_s.clear()
                os.write(robot, b"n\r\n")
                assert select.select([device.descriptor], [], [], 10)[0]
                time_s[0] += 1.0
            replies += read_available(host)
            return time_s[0] > 5

        relaying.relay(device, port, stop=step, notify=print)
        os.close(host)
    assert (commands, replies) == (b"N\nB\n", b"b\r\n")


# pyserial names its threads as Python did before 3.10.
def test_bytes_at_a_slow_speed_that_a_host_has_left_hold_the_next_one_back_for_a_moment() -> None:
    with loopback() as device, served("--relay", device) as (_, path):
        with serial.Serial(path, 300, stopbits=2, timeout=20) as port:
            port.write(b"\n\r" + b"x" * 2000)
            assert port.read(10)  # the line is at its speed
        with serial.Serial(path, 9600, stopbits=2, timeout=20) as port:
            assert ask(port, b"B\n").endswith(b"B\n")


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
@pytest.mark.parametrize("scheme", ["tcp", "rfc2217"])
def test_a_robot_on_the_network_is_reached_and_served_on(scheme: str) -> None:
    with (
        served("default", f"--{scheme}", "127.0.0.1:0") as (_, robot),
        served("--relay", robot, f"--{scheme}", "127.0.0.1:0") as (_, path),
        serial.serial_for_url(path, 9600, stopbits=2, timeout=2) as port,
    ):
        for _ in range(3):
            assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"


def test_a_robot_that_goes_is_reported_and_the_log_is_whole(tmp_path: Path) -> None:
    log = tmp_path / "robot.mcap"
    with served("default") as (twin, robot), served("--relay", robot, "--log", str(log)) as (process, path):
        with serial.Serial(path, 9600, stopbits=2, timeout=10) as port:
            assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
            twin.kill()
            twin.wait(60)
            process.wait(60)
        _, errors = process.communicate()
    assert process.returncode == 1
    started, failed = errors.splitlines()
    assert started.startswith(f"khep-twin: serving a robot at {robot}; ")
    assert failed.startswith(f"khep-twin: {robot}: the robot's port failed")
    assert [line.text for line in read_log(log).robots["khepera0"].serial] == ["B", "b,5.02,5.01"]


def test_noise_from_the_robot_is_logged_and_harms_nothing(tmp_path: Path) -> None:
    log = tmp_path / "robot.mcap"
    sent = b"n,1,2\nn,1,2,3,4,5,6,7,x\nn,1,2,3,4,5,6,7,8\n\xff\xfe\nD,1\ne,1\n,\n" + b"x" * 2000
    with served("--relay", "loop://", "--log", str(log)) as (process, path):
        with serial.Serial(path, 9600, stopbits=2, timeout=10) as port:
            port.write(sent)
            assert port.read(len(sent)) == sent
        assert stop(process)[0] == 0
    track = read_log(log).robots["khepera0"]
    assert track.proximity.tolist() == [[1, 2, 3, 4, 5, 6, 7, 8]]
    assert {line.text for line in track.serial} >= {"n,1,2", "\\xff\\xfe", "D,1", ","}


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_at_once_and_removes_its_link(tmp_path: Path, how: signal.Signals) -> None:
    link, log = tmp_path / "khepera", tmp_path / "robot.mcap"
    with served("--relay", "loop://", "--link", str(link), "--log", str(log)) as (process, _):
        start = time.monotonic()
        assert stop(process, how)[0] == 0
        assert time.monotonic() - start < 10  # it waits for no host
    assert not link.is_symlink()
    assert read_log(log).robots["khepera0"].serial == []


def test_a_host_that_leaves_amid_a_reply_of_several_lines_leaves_none_to_the_next() -> None:
    with served("default") as (_, robot), served("--relay", robot, "--tcp", ":0") as (process, url):
        with connected(url) as host:
            host.sendall(b"help\n")
            assert host.recv(1000).startswith(b"help")
        with connected(url) as host:
            host.sendall(b"B\n")
            assert host.recv(1000) == b"b,5.02,5.01\r\n"
        assert "a host" not in stop(process)[1]


def test_a_robot_that_speaks_all_the_time_keeps_no_next_host_waiting_for_ever(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    commands = b""
    with clocked_line(monkeypatch) as (robot, device, time_s), PtyPort() as port:
        host = opened(port)
        os.write(host, b"N\n")

        def step() -> bool:
            nonlocal commands, host
            time_s[0] += 0.01
            os.write(robot, b".")
            if data := read_available(robot):
                commands += data
                if commands == b"N\n":
                    os.close(host)
                    host = opened(port)
                    os.write(host, b"B\n")
            return commands.endswith(b"B\n") or time_s[0] > 60

        relaying.relay(device, port, stop=step, notify=print)
        os.close(host)
    assert commands == b"N\nB\n"


def test_a_reply_that_was_lost_does_not_end_the_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = b""
    with clocked_line(monkeypatch) as (robot, device, time_s), PtyPort() as port:
        monkeypatch.setattr(idle_polls, "time", relaying.time)

        def step() -> bool:
            nonlocal commands
            time_s[0] += 0.01
            if data := read_available(robot):
                commands += data
                if commands != b"N\n":  # the first one is lost
                    os.write(robot, b"h,0,0\r\n" if commands.endswith(b"H\n") else b"n,0,0,0,0,0,0,0,0\r\n")
            return commands.count(b"\n") == 3 or time_s[0] > 20

        relaying.relay(device, port, polls=IdlePolls([b"N\n", b"H\n"]), stop=step, notify=print)
    assert commands == b"N\nH\nN\n"


def test_a_robot_that_takes_no_more_is_still_heard_and_the_relay_ends() -> None:
    robot, device = os.openpty()
    tty.setraw(device)
    ended, replies = threading.Event(), b""
    with PtyPort() as port:
        arguments = (Device(os.ttyname(device), 9600), port)
        thread = threading.Thread(
            target=relaying.relay, args=arguments, kwargs={"stop": ended.is_set, "notify": print}, daemon=True
        )
        host = opened(port)
        thread.start()
        # More than the line takes: its other end is not read.
        full_since = time.monotonic()
        while time.monotonic() - full_since < 1.0:
            try:
                os.write(host, b"N\n" * 500)
                full_since = time.monotonic()
            except BlockingIOError:
                time.sleep(0.01)
        os.write(robot, b"n\r\n")
        if select.select([host], [], [], 5)[0]:
            replies = os.read(host, 100)
        ended.set()
        thread.join(5)
        was_alive = thread.is_alive()
        while thread.is_alive():  # a relay that hangs is let go
            os.read(robot, 100_000)
        os.close(host)
    os.close(robot)
    os.close(device)
    assert replies == b"n\r\n"
    assert not was_alive


@pytest.mark.parametrize(
    ("baud", "n_bytes", "busy_s"), [(9600, 480, 0.55), (300, 480, 1.0), (38400, 96, 0.0275)]
)
def test_the_line_is_quiet_once_the_sent_bytes_have_passed_or_after_a_second(
    baud: int, n_bytes: int, busy_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 5.0
    monkeypatch.setattr(relaying, "time", SimpleNamespace(monotonic=lambda: now_s))
    device = SimpleNamespace(write=len, read=lambda: b"", baud=baud, unsent=0)
    dialogue = relaying._Dialogue(device)
    sent_s = now_s = 6.0
    assert dialogue.send(b"x" * n_bytes) == b""
    for elapsed_s, is_quiet in (
        (0.9 * busy_s, False),
        (busy_s + 0.9 * 0.02, False),
        (busy_s + 1.1 * 0.02, True),
    ):
        now_s = sent_s + elapsed_s
        dialogue.read()
        assert dialogue.is_quiet == is_quiet
