"""`khep-twin exec`: programs compiled for the computers of robots, from the command line."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import khep_twin

from khep_twin.log.reader import read_log
from khep_twin.programs.preload import compiler_flags

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or shutil.which("cc") is None, reason="there is no Linux with a C compiler"
)

PROGRAMS = Path(__file__).parents[1] / "programs" / "sources"


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of compiled programs, which is their cache, too."""
    folder = tmp_path_factory.mktemp("programs")
    for name in ("drive", "threads", "forever"):
        source = PROGRAMS / f"{name}.c"
        subprocess.run(["cc", *compiler_flags(), "-o", folder / name, source, "-lpthread"], check=True)
    return folder


def test_a_program_drives_the_twin_and_its_code_and_log_are_kept(
    programs: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ("exec", "--log", "run.mcap", "--after", "0.5", "--", str(programs / "drive"))
    process = khep_twin(*words, folder=tmp_path)
    assert process.returncode == 3
    assert "revision B 0" in capfd.readouterr().out
    assert "view run.mcap" in process.stderr
    run = read_log(tmp_path / "run.mcap")
    assert (run.robots["khepera0"].proximity.shape[1], run.metadata["program"]) == (12, "drive")
    process = khep_twin("repeat", "run.mcap", folder=tmp_path)
    assert "a program drove it; expected a log of a serial line" in process.stderr


def test_the_same_seed_gives_the_same_log_with_threads_and_children(programs: Path, tmp_path: Path) -> None:
    logs: list[bytes] = []
    for name in ("a.mcap", "b.mcap"):
        khep_twin("exec", "--log", name, "--", str(programs / "threads"), folder=tmp_path)
        logs.append((tmp_path / name).read_bytes())
    assert logs[0] == logs[1]


def test_two_programs_share_a_playpen_and_the_end_of_their_time(
    programs: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    forever = str(programs / "forever")
    also = ("--also", f"{programs / 'drive'} now")
    words = ("exec", "--playpen", "arena4-two", "--seconds", "3", *also, "--", forever)
    process = khep_twin(*words, folder=tmp_path)
    assert "revision B 0" in capfd.readouterr().out
    assert process.returncode == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--playpen", "obstacles"),
            "robot 0: Khepera in obstacles; expected one with a computer: a playpen with model = ",
        ),
        (
            ("--playpen", "arena4-two", "--robot", "2"),
            "robot 2: Khepera in arena4-two; expected one with a computer: 0 (Khepera IV), 1 (Khepera IV)",
        ),
        (("--robot", "-1"), "robot -1: no robot in arena4; expected one with a computer: 0 (Khepera IV)"),
        (("--also", "true"), "2 programs; expected up to 1 from robot 0: 0 (Khepera IV)"),
        (("--also", "'true"), "expected a program and its arguments"),
    ],
)
def test_what_does_not_fit_is_one_line(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    process = khep_twin("exec", *words, "--", "true", folder=tmp_path)
    assert process.returncode in (1, 2)
    assert message in process.stderr
    assert process.stderr.count("\n") == 1


def test_a_killed_twin_leaves_no_program_and_a_log_that_can_be_recovered(
    programs: Path, tmp_path: Path
) -> None:
    words = [sys.executable, "-m", "khep_twin", "exec", "--log", "run.mcap", "--", str(programs / "forever")]
    twin = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    part = tmp_path / "run.mcap.part"
    deadline = time.monotonic() + 30
    while not (part.exists() and part.stat().st_size > 100_000) and time.monotonic() < deadline:
        time.sleep(0.02)
    twin.send_signal(signal.SIGKILL)
    twin.wait()
    while _runs(str(programs / "forever")) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _runs(str(programs / "forever"))
    assert khep_twin("recover", "run.mcap.part", folder=tmp_path).returncode == 0


def _runs(program: str) -> bool:
    """Return whether a program runs."""
    for name in os.listdir("/proc"):
        try:
            if name.isdigit() and Path("/proc", name, "cmdline").read_bytes().startswith(program.encode()):
                return True
        except OSError:
            continue
    return False
