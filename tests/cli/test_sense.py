"""The command `khep-twin sense`: its files, pictures and errors."""

import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from command_line import complaint, good, khep_twin, line_of
from forked import Forked
from served_twin import served

from khep_twin.errors import LogError
from khep_twin.lab.sensor_test.sensor_files import load
from khep_twin.log.entries import Entry
from khep_twin.log.tail import GrowingLog

BENCH = """
version = 1
name = "bench"

[arena]
width_mm = 1000
height_mm = 1000

[[robot]]
x_mm = 917.5
y_mm = 500
heading_deg = 0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One with a playpen, its robot 55 mm before a wall."""
    (tmp_path / "bench.toml").write_text(BENCH)
    return tmp_path


def test_a_test_is_written_in_every_form_and_drawn(folder: Path) -> None:
    outputs = [word for suffix in ("csv", "mat", "mcap") for word in ("-o", f"run.{suffix}")]
    words = ("--linear", 5, *outputs, "--picture", "run.png", "--text", "wall")
    output = good("sense", "khep://bench.toml?noise=off", *words, folder=folder)
    assert "left 10        0 to 1023 counts" in output
    runs = [load(folder / f"run.{suffix}") for suffix in ("csv", "mat", "mcap")]
    assert all((run.dv == runs[0].dv).all() and run.test == runs[0].test for run in runs)
    assert runs[0].dv[-1, 0] == pytest.approx(625, abs=2)
    assert runs[0].text == "wall"
    assert (folder / "run.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in folder.iterdir()) == [
        "bench.toml", "run.csv", "run.mat", "run.mcap", "run.png",
    ]  # fmt: skip


def test_two_runs_begin_at_the_same_place_and_are_numbered(folder: Path) -> None:
    words = ("--linear", 5, "--runs", 2, "-o", "run.csv")
    good("sense", "khep://bench.toml?noise=off", *words, folder=folder)
    first, second = load(folder / "run-1.csv"), load(folder / "run-2.csv")
    assert first.test.return_to_zero
    assert not second.test.return_to_zero
    assert abs(first.dv[-1] - second.dv[-1]).max() < 30
    assert not (folder / "run.csv").exists()


def test_earlier_runs_are_drawn_without_a_port_always_the_same(folder: Path) -> None:
    for seed in (1, 2):
        port = f"khep://bench.toml?seed={seed}"
        good("sense", port, "--rotate", -90, "--what", "light", "-o", f"{seed}.csv", folder=folder)
    drawn = ["--overlay", "1.csv", "--overlay", "2.csv", "--sensor", "back left", "--y-min", 200, "--grid"]
    for name in ("a.svg", "b.svg"):
        assert good("sense", *drawn, "--picture", name, folder=folder) == f"picture  {name}\n"
    assert (folder / "a.svg").read_bytes() == (folder / "b.svg").read_bytes()


def test_a_test_that_breaks_off_keeps_its_data_and_reports_why_in_one_line(folder: Path) -> None:
    words = ("khep://bench.toml?fault=dead:left", "--linear", 10, "-o", "run.csv")
    line = complaint("sense", *words, folder=folder, codes=[1])
    assert line.startswith("the test broke off after ")
    assert len(load(folder / "run.csv").dv) > 10


def drives(part: Path) -> bool:
    """Return whether a growing log has the command to drive."""
    try:
        with GrowingLog(part.with_suffix("")) as log:
            entries: list[Entry] = []
            while block := log.read_new():
                entries += block
    except LogError:  # it has only just begun
        return False
    return any(b"C," in message.data for message in entries)


def test_a_test_that_is_asked_to_end_keeps_its_data(folder: Path) -> None:
    log = folder / "twin.mcap"
    with served(str(folder / "bench.toml"), "--tcp", "127.0.0.1:0", "--log", str(log)) as (_, port):
        command = [sys.executable, "-m", "khep_twin", "sense", port, "--linear", "-60", "-o", "run.csv"]
        command += ["--speed", "5"]  # 15 s, so that it goes on by then on slow machines, too
        with Forked(command, stderr=subprocess.PIPE, text=True, cwd=folder) as sensing:
            part, end = log.with_suffix(".mcap.part"), time.monotonic() + 60
            while not part.exists() or not drives(part):
                assert time.monotonic() < end, "it does not drive"
                time.sleep(0.1)
            time.sleep(1)
            sensing.send_signal(signal.SIGINT)
            _, complaint = sensing.communicate(timeout=60)
    assert sensing.returncode == 130
    assert complaint.endswith("khep-twin: stopped before its end\n")
    assert -60 < load(folder / "run.csv").travelled[-1] < 0


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        ("", "there is nothing to do; expected a PORT such as khep://default, or --overlay FILE"),
        ("khep://default", "--linear and --rotate: none is given; expected one, --linear CM or --rotate DEG"),
        ("khep://default --linear 5 --rotate 90", "--linear and --rotate: both is given"),
        ("khep://default --linear 3", "linear = 3 cm; expected 5 to 60, or -5 to -60"),
        ("khep://default --linear 5 --speed 0", "speed = 0; expected an integer from 1"),
        ("khep://default --linear 5 --runs 0", "runs = 0; expected an integer from 1 to 100"),
        ("khep://default --linear 5 -o a.txt", "a.txt; expected a name that ends in .csv"),
        ("khep://default --linear 5 -o no/a.csv", "no/a.csv: cannot be written: there is no"),
        ("khep://default --linear 5 -o a.csv -o ./a.csv", "a.csv: is given twice"),
        ('khep://default --linear 5 --sensor "left 10"', "--sensor is for the picture"),
        (
            'khep://default --linear 5 --sensor "left 11" --picture a.png',
            "sensor = left 11: no such sensor; did you mean 'left 10'?",
        ),
        ("--linear 5", "--linear is for a robot; expected its PORT"),
        ("--overlay no.csv --picture a.png", "no.csv: cannot be read: No such file"),
    ],
)
def test_a_mistake_is_one_line_before_the_robot_moves(typed: str, line: str, tmp_path: Path) -> None:
    result = khep_twin("sense", *shlex.split(typed), folder=tmp_path)
    assert line_of(result, codes=[1]).startswith(line)
    assert not result.stdout
    assert not list(tmp_path.iterdir())


def test_a_picture_of_a_kind_that_cannot_be_drawn_is_refused_before_the_robot_moves(tmp_path: Path) -> None:
    words = ("khep://default", "--linear", "5", "--picture", "a.gif")
    error = complaint("sense", *words, folder=tmp_path, codes=[2])
    assert "a.gif: expected a name that ends in .png" in error
