"""A served twin as seen by a host program: another process behind a pseudo-terminal."""

import os
import select
import shutil
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from command_line import khep_twin
from forked import Forked, run_python
from scenes import arena, robot
from scheduling_delay import scheduling_delay
from served_twin import ask, exchange, served, stop

from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.log.reader import read_log
from khep_twin.process.invocation import command

TIMEOUT_S = 20.0
"""Wait for what must come, on machines of any load [s]."""

VERSIONS = b"b,5.02,5.01\r\n"
"""Reply to B."""


@pytest.fixture(scope="module")
def path() -> Iterator[str]:
    with served("default", "--noise", "off") as (_, path):
        yield path


@pytest.mark.parametrize("ending", [b"\n", b"\r", b"\r\n"])
def test_a_host_in_pyserial_gets_its_reply(path: str, ending: bytes) -> None:
    with serial.Serial(path, 9600, stopbits=2, timeout=TIMEOUT_S) as port:
        assert ask(port, b"B" + ending) == VERSIONS


def test_the_reply_takes_its_time_on_the_line(path: str) -> None:
    with scheduling_delay() as late, serial.Serial(path, 9600, stopbits=2, timeout=TIMEOUT_S) as port:
        start = time.monotonic()
        reply = ask(port, b"N\n")
        took = time.monotonic() - start
    assert reply.count(b",") == 8
    assert took >= (2 + len(reply)) * 11 / 9600 * 0.95
    late.excuse(0.05)
    assert took < 0.5


def test_a_host_may_set_another_speed_or_one_stop_bit(path: str) -> None:
    with serial.Serial(path, 57600, stopbits=1, timeout=TIMEOUT_S, rtscts=True) as port:
        assert ask(port, b"B\n") == VERSIONS


def test_single_bytes_and_bursts_are_answered_in_order(path: str) -> None:
    with serial.Serial(path, 9600, timeout=TIMEOUT_S) as port:
        for byte in b"G,5,6\n":
            port.write(bytes((byte,)))
            time.sleep(0.002)
        port.write(b"H\nhello\nD,1\nB\nE\nK\nG,0,0\n")
        replies = [port.readline() for _ in range(8)]
    assert replies[:5] == [
        b"g\r\n",
        b"h,5,6\r\n",
        b"Command not found\r\n",
        b"z,Protocol error\r\n",
        b"b,5.02,5.01\r\n",
    ]
    assert replies[7] == b"g\r\n"


def test_a_host_in_c_style_reads_and_writes_a_descriptor(path: str) -> None:
    assert exchange(path, b"B\r", VERSIONS, TIMEOUT_S) == VERSIONS


def test_our_own_host_drives_it_in_real_time(path: str) -> None:
    with scheduling_delay() as late, Khepera(path) as host:
        host.set_position(0, 0)
        host.set_speed(5, 5)
        start = time.monotonic()
        time.sleep(0.6)
        left, right = host.position()
        took = time.monotonic() - start
        host.set_speed(0, 0)
    late.excuse(0.02)
    # 500 pulses a second, less the start.
    assert left == pytest.approx(500 * took, rel=0.15)
    assert right == pytest.approx(left, abs=5)


def test_noise_at_full_speed_is_survived(path: str) -> None:
    # Within the rubbish no line takes longer than 0.3 s to cross the wire.
    with serial.Serial(path, 9600, timeout=0.6, write_timeout=5) as port:
        port.write(bytes(range(256)) * 8)
        deadline = time.monotonic() + 10
        while port.read(1000) and time.monotonic() < deadline:
            pass
        port.timeout = TIMEOUT_S
        port.write(b"\nB\n")
        assert port.read_until(b"5.01\r\n").endswith(b"b,5.02,5.01\r\n")


def test_the_example_runs_unchanged_on_a_pty(path: str) -> None:
    example = Path(__file__).parents[2] / "examples" / "01_braitenberg.py"
    assert run_python([sys.executable, str(example), path, "20"], timeout=300).returncode == 0


def reply_of_the_next_host(path: str) -> bytes:
    """Return the first reply to a host that opens the port as C programs do, 0.2 s after the last one."""
    time.sleep(0.2)
    return exchange(path, b"B\n", VERSIONS, TIMEOUT_S)


def test_a_host_that_leaves_replies_and_half_a_command_behind_does_not_spoil_the_next(path: str) -> None:
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    os.write(descriptor, b"N\n" * 20 + b"C,12")
    time.sleep(0.2)
    os.close(descriptor)
    assert reply_of_the_next_host(path) == VERSIONS


def test_a_host_that_is_killed_does_not_spoil_the_next(path: str) -> None:
    program = (
        "import os, sys, time; port = os.open(sys.argv[1], os.O_RDWR)\n"
        "while True: os.write(port, b'N\\n'); time.sleep(0.01)"
    )
    with Forked([sys.executable, "-c", program, path]) as host:
        time.sleep(0.3)
        host.kill()
    assert reply_of_the_next_host(path) == VERSIONS


def test_settings_that_a_host_leaves_behind_are_put_right(path: str) -> None:
    subprocess.run(["stty", "-F", path, "sane"], check=True)
    assert reply_of_the_next_host(path) == VERSIONS
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    termios.tcflow(descriptor, termios.TCOOFF)
    os.close(descriptor)
    assert reply_of_the_next_host(path) == VERSIONS


def test_the_last_command_of_a_host_that_closes_at_once_is_carried_out(path: str) -> None:
    for number in range(3):
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        os.write(descriptor, b"G,%d,7\n" % (100 * number))
        os.close(descriptor)
        time.sleep(0.3)
        with Khepera(path) as host:
            assert host.position() == pytest.approx((100 * number, 7), abs=2)
        time.sleep(0.1)  # a host that comes in the very moment another goes may be taken for it


def test_at_full_speed_without_line_time_answers_come_at_once() -> None:
    with (
        scheduling_delay() as late,
        served("default", "--speed", "max", "--unpaced") as (_, path),
        serial.Serial(path, 9600, timeout=TIMEOUT_S) as port,
    ):
        start = time.monotonic()
        for _ in range(100):
            assert ask(port, b"B\n") == VERSIONS
        took = time.monotonic() - start
    late.excuse(0.005)
    # On a line they would take 1.8 s.
    assert took < 1


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_finishes_the_log_and_removes_the_link(how: signal.Signals, tmp_path: Path) -> None:
    log, link = tmp_path / "run.mcap", tmp_path / "khepera"
    with served("default", "--log", str(log), "--link", str(link)) as (process, path):
        assert path == str(link)
        with serial.Serial(path, 9600, timeout=TIMEOUT_S) as port:
            ask(port, b"B\n")
        code, errors = stop(process, how)
    assert code == 0
    first_line, *_, last_line, log_line = errors.splitlines()
    assert (
        first_line
        == "khep-twin: serving a twin in default; hosts open the paths in the next lines; Ctrl-C ends it"
    )
    assert "s served" in last_line
    assert log_line == f"log      {log}      look at it: {command('view', log)}"
    assert not os.path.lexists(link)
    transcript = [line.text for line in read_log(log).robots["khepera0"].serial]
    assert transcript == ["B", "b,5.02,5.01"]


def test_a_killed_server_loses_less_than_a_second_and_is_announced_next_time(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with served("default", "--log", str(log)) as (process, _):
        part = tmp_path / "run.mcap.part"
        end = time.monotonic() + 60
        while part.stat().st_size < 20_000:
            assert time.monotonic() < end, "nothing is written"
            time.sleep(0.05)
        process.kill()
    assert not log.exists()
    with served("default", "--log", str(log)) as (process, _):
        code, errors = stop(process)
    assert code == 0
    assert "an unfinished log of an earlier run is kept as" in errors
    assert (tmp_path / "run.mcap.part.1").exists()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--tcp", "0.0.0.0:0"], "other machines could drive the robot from there; expected 127.0.0.1:0"),
        (["--tcp", "nowhere"], "nowhere: expected HOST:PORT"),
        (["--tcp", "127.0.0.1:99999"], "expected HOST:PORT"),
        (["--tcp", ":0", "--rfc2217", ":0"], "one cable each; expected one of them"),
        (["--tcp", "no.such.host.invalid:0", "--allow-remote"], "cannot listen here"),
        (["--fault", "nope"], "fault 'nope': unknown"),
        (["--clock", "wire", "--speed", "2"], "--speed: has no effect with --clock wire"),
        (["--strict-line", "--tcp", ":0"], "--strict-line: hosts at --tcp have no baud rate"),
        (["--tcp", ""], "expected HOST:PORT"),
        (["--link", ""], "--link '': expected a name"),
        (["nowhere"], "khep-twin: nowhere: no such file"),
        (["--speed", "fast"], "khep-twin: --speed fast: expected a number from 0.001 to 1000, or max"),
        (["--speed", "-1"], "khep-twin: --speed -1: expected a number from 0.001 to 1000, or max"),
        (["--mode", "9"], "khep-twin: mode = 9 with rom = '5.02': mode 9 is a mode of the Khepera II"),
        (["--link", "/nowhere/link"], "khep-twin: /nowhere/link: cannot make this link"),
        (["--relay", "/dev/no-such-robot"], "/dev/no-such-robot: cannot open this port"),
        (["--relay", "nonsense://x"], "nonsense://x: cannot open this port"),
        (["--relay", "khep://default"], "khep://default: a twin needs no relay; expected khep-twin serve"),
        (["obstacles", "--relay", "loop://"], "PLAYPEN is for a twin, not for a robot at --relay"),
        (["--relay", "loop://", "--speed", "2"], "--speed is for a twin"),
        (["--relay", "loop://", "--fault", "stuck:1"], "--fault is for a twin"),
        (["--relay", "loop://", "--mode", "4"], "--mode 4: mode 4"),
        (["--relay", "loop://", "--model", "other"], "model = 'other': unknown"),
        (["--relay", "loop://", "--log", "/no/such/folder/a.mcap"], "cannot write a log here"),
    ],
)
def test_what_cannot_be_served_is_one_line_and_no_trace(arguments: list[str], line: str) -> None:
    completed = khep_twin("serve", *arguments)
    assert completed.returncode in (1, 2)
    assert completed.stdout == ""
    assert completed.stderr.startswith("khep-twin: ")
    assert line in completed.stderr
    assert completed.stderr.count("\n") == 1


def test_after_a_kill_the_next_start_takes_the_link_again(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    with served("default", "--link", str(link)) as (process, path):
        process.kill()
        process.wait()
    assert os.path.lexists(link)
    with served("default", "--link", str(link)) as (_, path):
        with serial.Serial(path, 9600, stopbits=2, timeout=TIMEOUT_S) as port:
            assert ask(port, b"B\n") == VERSIONS
    assert list(tmp_path.iterdir()) == []


def test_a_link_in_use_is_not_taken(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    with served("default", "--link", str(link)):
        completed = khep_twin("serve", "--link", link)
        assert completed.returncode == 1
        assert "another khep-twin serves under this name" in completed.stderr
        assert link.is_symlink()


@pytest.mark.parametrize("several", [False, True])
def test_a_link_in_the_current_directory_lies_where_it_says(
    several: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name = "default"
    if several:
        name = "two.toml"
        Path(name).write_text(arena() + robot(300, 250) + robot(100, 100))
    with served(name, "--link", "./khepera") as (_, path):
        link_path = tmp_path / ("khepera0" if several else "khepera")
        assert path == str(link_path)
        assert link_path.is_symlink()
        with serial.Serial(f"./{link_path.name}", timeout=TIMEOUT_S) as port:
            assert ask(port, b"B\n") == VERSIONS
    assert not link_path.is_symlink()


def test_who_opens_a_bare_name_sees_where_that_link_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with served("default", "--link", "khepera") as (_, path):
        with pytest.raises(PortError, match=rf"^khepera: .* under this name is at {path}$"):
            Khepera("khepera")


def test_a_bare_link_lies_in_a_private_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with served("default", "--link", "khepera", "--mode", "7") as (process, path):
        assert path == str(tmp_path / "khep_twin" / "khepera")
        assert (tmp_path / "khep_twin").stat().st_mode & 0o777 == 0o700
        assert b"Self test" in exchange(path, b"restart\n", bytes(150))
        _, errors = stop(process)
    assert "mode 7: the self-test has run at power-up; hosts that send restart get its report" in errors
    assert "next lines, in a private directory (--link ./khepera is in this one)" in errors


def test_a_descriptor_reports_when_hosts_may_come() -> None:
    reader, writer = os.pipe()
    with served("default", "--ready-fd", str(writer), pass_fds=(writer,)) as (_, path):
        os.close(writer)
        with open(reader) as ready:
            assert ready.read() == f"{path}\n"


def test_stty_and_a_shell_get_a_reply(path: str) -> None:
    subprocess.run(["stty", "-F", path, "9600", "cstopb", "raw", "-echo"], check=True)
    time.sleep(0.2)
    script = f"exec 3<>{path}; printf 'B\\n' >&3; read -r -t 20 line <&3; echo \"$line\""
    completed = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert completed.stdout.strip() == "b,5.02,5.01"


@pytest.mark.parametrize("tool", ["socat", "picocom"])
def test_terminal_programs_get_a_reply(path: str, tool: str) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is not installed")
    commands = {
        "socat": ["socat", "-t", "2", "-", f"{path},b9600,cstopb=1,raw,echo=0"],
        "picocom": ["picocom", "-q", "-b", "9600", "-p", "2", "-x", "3000", path],
    }
    completed = subprocess.run(
        commands[tool], input="B\n", capture_output=True, text=True, timeout=120, check=False
    )
    assert "b,5.02,5.01" in completed.stdout


def test_miniterm_gets_a_reply(path: str) -> None:
    command = [sys.executable, "-m", "serial.tools.miniterm", "--raw", path, "9600"]
    # It wants its own terminal to read keys from.
    master, keys = os.openpty()
    with subprocess.Popen(command, stdin=keys, stdout=keys, stderr=keys, close_fds=True) as process:
        os.close(keys)
        output, end = b"", time.monotonic() + 60
        while b"b,5.02,5.01" not in output:
            assert time.monotonic() < end, output
            # What is typed before it has begun is lost.
            os.write(master, b"B\n")
            while select.select([master], [], [], 1)[0]:
                output += os.read(master, 4096)
        process.kill()
    os.close(master)


def test_a_khepera_2_is_served_by_its_model_and_its_firmware_alone_is_reported() -> None:
    with served("default", "--model", "khepera2", "--mode", "9") as (process, path):
        with serial.Serial(path, 115200, stopbits=2, timeout=TIMEOUT_S) as port:
            assert ask(port, b"B\n") == b"b,6.01,5.01\r\n"
        _, errors = stop(process)
    assert "baud" not in errors
    with served("default", "--rom", "khepera2") as (process, _):
        _, errors = stop(process)
    assert "--rom khepera2 changes the firmware only" in errors


def test_the_notice_of_another_speed_names_the_mode_and_one_stop_bit_is_no_reason_for_one() -> None:
    with served("default") as (process, path):
        for speed in (9600, 38400, 57600, 38400):
            with serial.Serial(path, speed, stopbits=1, timeout=TIMEOUT_S) as port:
                assert ask(port, b"B\n") == VERSIONS
        _, errors = stop(process)
    warnings = [line for line in errors.splitlines() if "baud" in line]
    assert len(warnings) == 2
    assert "the host has its line at 38400 baud, the robot's has 9600" in warnings[0]
    assert "serve --mode 3" in warnings[0]
    assert "serve --model khepera2 --mode 8" in warnings[1]


def test_after_the_tool_serial_the_next_host_finds_the_robots_speed() -> None:
    def speed(path: str) -> int:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        try:
            return termios.tcgetattr(descriptor)[5]
        finally:
            os.close(descriptor)

    with served("default", "--strict-line") as (process, path):
        assert speed(path) == termios.B9600
        assert exchange(path, b"serial 38400\n", b"serial 38400\r\n") == b"serial 38400\r\n"
        end = time.monotonic() + TIMEOUT_S
        while speed(path) != termios.B38400 and time.monotonic() < end:
            time.sleep(0.05)
        assert exchange(path, b"B\n", VERSIONS) == VERSIONS
        _, errors = stop(process)
    assert "baud" not in errors


def test_a_speed_without_a_constant_is_reported_as_it_is() -> None:
    with (
        served("default") as (process, path),
        serial.Serial(path, 31250, stopbits=2, timeout=TIMEOUT_S) as port,
    ):
        assert ask(port, b"B\n") == VERSIONS
        _, errors = stop(process)
    assert "the host has its line at 31250 baud, the robot's has 9600" in errors
