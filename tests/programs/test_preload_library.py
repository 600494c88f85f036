"""The preload library: file descriptors of the bus, refused arguments, waits, and external programs."""

import os
import pty
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from test_compiled_programs import machine, machine_of, output_of, pytestmark, run_program

from khep_twin.programs.robot_program import RobotProgram, run_programs
from khep_twin.world import World

__all__ = ["pytestmark"]

VTIME = """
import sys, termios, time
settings = termios.tcgetattr(0)
settings[3] &= ~termios.ICANON
settings[6][termios.VMIN], settings[6][termios.VTIME] = 0, 1
termios.tcsetattr(0, termios.TCSANOW, settings)
start = time.monotonic()
for _ in range(5):
    assert sys.stdin.buffer.raw.read(1) == b""
print(time.monotonic() - start)
"""


def test_a_number_that_was_the_buss_becomes_a_file_and_copies_stay_the_bus(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    world = World("arena4")
    assert run_program([str(programs / "handles")], machine_of(world)) == 0
    assert capfd.readouterr().out.splitlines() == [
        "fclose reused 5 5",
        "freopen reused 5 5",
        "to the bus 0 1",
        "stream -1",
        "call reused 5 5",
        "closefrom reused 5 5",
        "range reused 5 5",
        "dup2 -1 1",
        "F_DUPFD 0 1",
        "shared -1",
        "vectors 2 2",
        "offsets 1 2",
        "calls 1 1",
        "inherited 8 9",
        "timer reused 5 5",
        "after 5",
    ]
    assert world.poses[0] == World("arena4").poses[0]  # what was meant for files has not driven the robot


def test_smbus_blocks_are_answered_and_bad_arguments_refused_as_by_the_kernel(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    refused = ["bad message", "bad target", "bad messages", "bad argument", "bad smbus", "bad functions"]
    refused += ["bad write", "bad read"]
    refused_later = ["bad path", "bad pin", "bad sleep", "bad select", "bad limit", "bad poll", "bad futex"]
    assert output_of(programs / "smbus", capfd) == [
        "write block 0:",
        "read block 0: 4 16 12 0 0",
        "broken block 0: 32 16 12 0 0",
        "process call 0: 16 1",
        "smbus block write 0",
        "smbus block 0: 0 0 0",
        *("long block EINVAL", "quick EINVAL", "size EINVAL", "no data EINVAL", "bad data EFAULT"),
        "functions 0",
        "quick 0, blocks 1, slave data 0",
        "no messages EINVAL",
        *(f"{name} EFAULT" for name in refused),
        *("empty EINVAL", "slave EINVAL"),
        *(f"{name} EFAULT" for name in refused_later),
    ]


def test_waits_of_c11_futexes_and_sockets_take_simulated_time(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert output_of(programs / "c11", capfd) == [
        "thrd_sleep 0 0.30",
        "cnd_timedwait 1 0.30",
        "mtx_timedlock 1 0.30",
        "cnd_wait 1 0.20",
        "futex 0 0.20",
        "futex at once 1 0.00",
        "futex in vain 1 0.30",
        "thrd_join 7 0.20",
        "timedjoin 1 0.40",
        "semtimedop 1 0.30",
        "recv 1 0.30",
        "read 1 0.30",
        "call 0 0.30",
    ]


@pytest.mark.skipif(shutil.which("c++") is None, reason="there is no C++ compiler")
def test_waits_of_futures_semaphores_and_atomics_of_c_plus_plus_take_simulated_time(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    source = Path(__file__).parent / "sources" / "futures.cpp"
    subprocess.run(["c++", "-std=c++20", "-o", tmp_path / "futures", source, "-lpthread"], check=True)
    assert output_of(tmp_path / "futures", capfd) == [
        "in vain 1 0.30",
        "async 1 0.20",
        "value 1 0.00",
        "semaphore in vain 1 0.30",
        "semaphore 1 0.10",
        "atomic 1 0.10",
    ]


@pytest.mark.parametrize("how", ["wait", "limit", "poll"])
def test_time_passes_with_the_wall_clock_while_a_server_waits_for_another_program(
    programs: Path, capfd: pytest.CaptureFixture[str], how: str
) -> None:
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.settimeout(30)
    answers: list[tuple[float, float, int]] = []

    def ask(text: bytes) -> None:
        line.send(text)
        seconds, pulses = line.recv(100).split()
        answers.append((time.monotonic(), float(seconds), int(pulses)))

    def run_client() -> None:
        while not (output := capfd.readouterr().out):
            time.sleep(0.01)
        line.connect(("127.0.0.1", int(output)))
        for _ in range(20):
            ask(b"where")
            time.sleep(0.03)
        line.send(b"quit")

    n_calls: list[int] = []
    client = threading.Thread(target=run_client)
    client.start()
    program = RobotProgram([str(programs / "server"), how], machine())
    assert run_programs([program], on_wall_clock=lambda: n_calls.append(1)) == [0]
    client.join()
    line.close()
    (wall_start, start, _), *_, (wall_end, end, pulses) = answers
    assert n_calls == [1]
    # On a busy machine the program waits for less than this time.
    assert 0.1 * (wall_end - wall_start) < end - start < 1.5 * (wall_end - wall_start) + 0.1
    assert pulses > 100


def test_a_terminal_that_is_read_with_a_time_out_takes_that_time(capfd: pytest.CaptureFixture[str]) -> None:
    keyboard, terminal = pty.openpty()
    stdin = os.dup(0)
    os.dup2(terminal, 0)
    try:
        assert run_program([sys.executable, "-c", VTIME], machine()) == 0
    finally:
        os.dup2(stdin, 0)
        for fd in (stdin, keyboard, terminal):
            os.close(fd)
    assert 0.45 < float(capfd.readouterr().out) < 2
