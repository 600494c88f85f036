"""`khep-twin run` in series, `series` and `new`, as processes."""

import csv
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
from command_line import complaint, good, khep_twin
from forked import Forked, run_python
from scipy.io import loadmat
from served_twin import served

from khep_twin.files import toml_files
from khep_twin.log.reader import read_log
from khep_twin.playpen import Playpen, dump
from stand_ins.fake_robot import FakeRobot

PROGRAM = (sys.executable, "-m", "khep_twin")
# Slow enough for a signal to come in between, and its own chance as the robot's.
LEARNS = """
from khep_twin.lab.experiment.controllers import Controller
class Learns(Controller):
    def __init__(self):
        self.speed = 3
        self.seen = []
    def start(self, robot):
        self.speed += 1
        self.seen = []
    def cycle(self, robot):
        self.seen.append(max(robot.proximity()))
        robot.ambient()
        robot.set_speed(self.speed, 5)
"""
PLAIN = """
def controller(robot):
    near = max(robot.proximity())
    robot.set_speed(5, -5 if near > 300 else 5)
    return {"near": near}
"""
ACROSS = ("--playpen", "obstacles", "--cycles", "60", "--runs", "4")


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "runs.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@contextmanager
def started(folder: Path, *words: object) -> "Iterator[subprocess.Popen[str]]":
    """`khep-twin run`, of which a run has ended."""
    command = [*PROGRAM, "run", *map(str, words)]
    with Forked(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            end = time.monotonic() + 120
            while not (folder / "series" / "runs.csv").exists():
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < end, "no run has ended"
                time.sleep(0.02)
            yield process
        finally:
            process.kill()


def read_rows(folder: Path, short: bool = False) -> list[dict[str, str]]:
    """Return the columns that are equal for all kinds of ports; with `short` also for all request times."""
    names = ["run", "cycles", "fitness", "near_share", "proximity_max", "proximity_mean", "speed_mean"]
    names += ["ambient_mean", "ambient_min", "speed"]
    assert {*names} <= {*rows(folder)[0]}
    return [{name: row[name] for name in (names[:2] if short else names)} for row in rows(folder)]


def test_a_script_comes_out_the_same_in_this_process_and_behind_a_terminal(tmp_path: Path) -> None:
    (tmp_path / "learns.py").write_text(LEARNS)
    words = ("run", "learns.py", "--cycles", "60", "--runs", "2")
    good(*words, "--playpen", "obstacles", "--noise", "off", "--save", "a", folder=tmp_path)
    good(*words, "--port", "khep://obstacles?noise=off", "--save", "b", folder=tmp_path)
    with served("obstacles", "--noise", "off", "--clock", "wire") as (_, path):
        good(*words, "--port", path, "--save", "c", folder=tmp_path)
    assert read_rows(tmp_path / "a") == read_rows(tmp_path / "b") == read_rows(tmp_path / "c")
    assert [row["speed"] for row in rows(tmp_path / "c")] == ["4", "5"]
    for number in (1, 2):
        one, other = (loadmat(tmp_path / name / f"run-00{number}.mat")["seen"] for name in "ac")
        assert one.tolist() == other.tolist()


def test_in_real_time_it_comes_out_the_same_up_to_timing(tmp_path: Path) -> None:
    (tmp_path / "learns.py").write_text(LEARNS)
    words = ("run", "learns.py", "--cycles", "12", "--runs", "2", "--save")
    good(*words, "a", "--noise", "off", folder=tmp_path)
    with served("default", "--noise", "off") as (_, path):
        good(*words, "b", "--port", path, folder=tmp_path)
    one, other = rows(tmp_path / "a"), rows(tmp_path / "b")
    for name in ("run", "cycles", "speed", "fitness", "speed_mean", "proximity_max", "ambient_mean"):
        assert [row[name] for row in one] == [row[name] for row in other]
    # A busy machine is late, never early.
    assert all(float(b["duration_s"]) > 0.9 * float(a["duration_s"]) for a, b in zip(one, other, strict=True))


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("script", "options"),
    [
        (PLAIN, ("--start", "grid:3x1", "--start", "playpen")),
        (LEARNS, ()),
        (LEARNS, ("--start", "random")),
    ],
)
def test_a_series_that_was_stopped_goes_on_to_the_very_same_table(
    script: str, options: Sequence[str], tmp_path: Path
) -> None:
    (tmp_path / "mine.py").write_text(script)
    words = ("mine.py", "--playpen", "obstacles", "--cycles", "40", *options)
    with started(tmp_path, *words, "--runs", "40", "--save", "series", "--log", "run.mcap") as process:
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    n_rows = len(rows(tmp_path / "series"))
    assert errors.endswith(f"stopped before its end; {n_rows} of 40 runs are saved; resume with --resume\n")
    assert "khep-twin series series" in output
    log = read_log(sorted(tmp_path.glob("run*.mcap"))[-1])
    # The last setpoints of the log are those of motors that stand.
    assert [line.text for line in log.robots["khepera0"].serial if line.text.startswith("D")][-1] == "D,0,0"
    assert not [*tmp_path.glob("*.part")]
    total = str(n_rows + 2)
    resumed_output = good("run", *words, "--runs", total, "--save", "series", "--resume", folder=tmp_path)
    assert resumed_output.count("run ") >= 2
    good("run", *words, "--runs", total, "--save", "whole", folder=tmp_path)
    names = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert names == sorted(path.name for path in (tmp_path / "series").iterdir())
    for name in names:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "series" / name).read_bytes(), name


def test_only_the_same_series_goes_on(tmp_path: Path) -> None:
    mine = tmp_path / "mine.py"
    mine.write_text(PLAIN)
    words = ("run", "mine.py", "--cycles", "3", "--save", "s")
    good(*words, folder=tmp_path)
    before = (tmp_path / "s" / "series.json").read_bytes()
    for options, line in (
        (("--seed", "1"), "s: was made with another seed: 0, now 1; expected the same"),
        (("--playpen", "obstacles"), "s: was made with another playpen: "),
        (("--start", "playpen"), "s: was made with another starts: [], now ['playpen']"),
        (("--lighting", "random"), 's: was made with another playpen: mode = "all", now mode = "random"'),
    ):
        assert complaint(*words, "--resume", *options, folder=tmp_path).startswith(line)
    assert complaint(*words, folder=tmp_path).startswith("s: has a series of 1 runs already; expected --res")
    mine.write_text(PLAIN.replace("300", "301"))
    assert "another controller source: sha256" in complaint(*words, "--resume", folder=tmp_path)
    assert (tmp_path / "s" / "series.json").read_bytes() == before


def test_a_controller_with_randomness_of_its_own_is_reported_on_resume(tmp_path: Path) -> None:
    text = (
        "import random\n\ndef controller(robot):\n    robot.position()\n    return {'luck': random.random()}"
    )
    (tmp_path / "mine.py").write_text(text)
    words = ("run", "mine.py", "--cycles", "3", "--save", "s", "--start", "playpen")
    good(*words, folder=tmp_path)
    line = complaint(*words, "--runs", "2", "--resume", folder=tmp_path)
    assert line.startswith("s: run 1, repeated, has luck ")
    assert len(rows(tmp_path / "s")) == 1


def test_a_refused_series_leaves_an_earlier_log_alone(tmp_path: Path) -> None:
    words = ("run", "--cycles", "3", "--save", "s", "--log", "run.mcap")
    good(*words, folder=tmp_path)
    before = (tmp_path / "run.mcap").read_bytes()
    complaint(*words, "--seed", "5", folder=tmp_path)
    assert (tmp_path / "run.mcap").read_bytes() == before
    assert not [*tmp_path.glob("*.part")]


def test_a_resumed_series_replaces_logs_of_its_own_controller_only(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PLAIN)
    words = ("run", "mine.py", "--cycles", "3", "--save", "s")
    good(*words, "--log", "own.mcap", folder=tmp_path)
    good("run", "--cycles", "3", "--log", "other.mcap", folder=tmp_path)
    other = (tmp_path / "other.mcap").read_bytes()
    options = ("--runs", "2", "--resume", "--log")
    assert "is there already" in complaint(*words, *options, "other.mcap", folder=tmp_path)
    assert (tmp_path / "other.mcap").read_bytes() == other
    good(*words, *options, "own.mcap", folder=tmp_path)


def test_a_user_function_is_called_with_each_new_run(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        PLAIN + "\nseen = []\n\ndef after(run):\n"
        "    seen.append(run.metrics['fitness'])\n"
        "    print('after', run.number, run.cycles, len(seen), run.variables['near'])\n"
    )
    words = ("run", "mine.py", "--on-run-end", "mine.py", "--cycles", "3", "--noise", "off", "--save", "s")
    output = good(*words, "--runs", "2", folder=tmp_path)
    assert [line for line in output.splitlines() if line.startswith("after")] == [
        "after 1 3 1 0",
        "after 2 3 2 0",
    ]
    output = good(*words, "--runs", "3", "--resume", folder=tmp_path)
    assert [line for line in output.splitlines() if line.startswith("after")] == ["after 3 3 1 0"]
    assert output.count("as before") == 2
    for text, line in (
        ("def after(run):\n    run.nothing", "bad.py:2: AttributeError: "),
        ("def after(run, more): ...", "bad.py: 'after' takes (run, more); expected one run"),
        ("def other(run): ...\ndef another(run): ...", "bad.py: no function 'after' that takes a run"),
        ("x = (", "bad.py:1: SyntaxError"),
    ):
        (tmp_path / "bad.py").write_text(text)
        output = complaint("run", "--on-run-end", "bad.py", "--cycles", "1", folder=tmp_path)
        assert output.removeprefix(f"{tmp_path}/").startswith(line)
    assert "no such function; expected" in complaint("run", "--on-run-end", "bad", folder=tmp_path)


@pytest.mark.parametrize(
    "place", ["__init__(self)", "start(self, robot)", "end(self, robot)", "stop(self, robot)"]
)
def test_a_place_that_fails_is_one_line(place: str, tmp_path: Path) -> None:
    text = "from khep_twin.lab.experiment.controllers import Controller\n"
    text += f"class Mine(Controller):\n    def {place}:\n"
    text += "        raise ValueError('mine')\n    def cycle(self, robot): robot.position()\n"
    (tmp_path / "mine.py").write_text(text)
    line = complaint("run", "mine.py", "--cycles", "2", folder=tmp_path)
    assert line.startswith("mine.py:4: ") or "/mine.py:4: " in line
    assert "ValueError: mine" in line


def test_before_each_run_a_person_is_waited_for(tmp_path: Path) -> None:
    command = [*PROGRAM, "run", "--confirm", "--cycles", "1", "--runs", "2"]
    result = run_python(command, cwd=tmp_path, input="\nready\n", timeout=60)
    assert result.returncode == 0
    assert result.stderr.count("place the robot, then press Enter") == 2
    ended = run_python(command, cwd=tmp_path, input="\n", timeout=60)
    assert ended.returncode == 1
    error = "khep-twin: --confirm: the input ended before run 2; expected a terminal"
    assert ended.stderr.splitlines()[-2:] == ["run 2: place the robot, then press Enter ", error]


def test_ctrl_c_ends_the_wait_for_a_person(tmp_path: Path) -> None:
    host, terminal = pty.openpty()
    command = [*PROGRAM, "run", "--confirm", "--cycles", "1", "--save", "s"]
    with Forked(
        command, cwd=tmp_path, stdin=terminal, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as process:
        assert process.stderr is not None
        assert os.read(process.stderr.fileno(), 100).startswith(b"run 1: place")
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
        assert b"0 of 1 runs are saved" in process.stderr.read()
    os.close(host)
    os.close(terminal)
    good("run", "--cycles", "1", "--save", "s", "--resume", folder=tmp_path)


def test_a_twin_that_is_killed_in_mid_run_is_one_error_and_nothing_is_lost(tmp_path: Path) -> None:
    link, part = tmp_path / "link", tmp_path / "served.mcap.part"
    options = ("obstacles", "--clock", "wire", "--log", str(tmp_path / "served.mcap"), "--link", str(link))
    with served(*options) as (twin, _):
        words = ("--port", link, "--cycles", "20", "--runs", "100000", "--save", "series")
        with started(tmp_path, *words) as process:
            # A log is written in pieces: a twin that is killed before the first has none.
            written, end = part.stat().st_size, time.monotonic() + 60
            while part.stat().st_size == written:
                assert time.monotonic() < end, "nothing is written"
                time.sleep(0.02)
            twin.kill()
            _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.count("\n") == 1, errors
    assert "the motors may still run" in errors
    assert rows(tmp_path / "series")[0]["run"] == "1"
    assert "run" in good("series", "series", folder=tmp_path)
    recovered = khep_twin("recover", "served.mcap.part", folder=tmp_path)
    assert recovered.returncode in (0, 3), recovered.stderr
    assert len(read_log(tmp_path / "served.mcap").robots["khepera0"].times_ns) >= 1


def test_a_terminal_that_closes_and_a_peer_that_goes_are_one_error(tmp_path: Path) -> None:
    with FakeRobot() as robot:
        words = ("--port", robot.url, "--cycles", "5", "--runs", "100000", "--save", "series")
        with started(tmp_path, *words) as process:
            robot.disconnect(for_good=True)
            _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.count("\n") == 1, errors
    assert "the motors may still run" in errors
    host, terminal = pty.openpty()
    path = os.ttyname(terminal)
    with Forked(
        [*PROGRAM, "run", "--port", path], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    ) as process:
        assert os.read(host, 1)
        os.close(terminal)
        os.close(host)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert errors.startswith(f"khep-twin: {path}: ")
    assert errors.count("\n") == 1, errors


def test_starts_have_logs_and_tracks_of_their_own(tmp_path: Path) -> None:
    words = ("--start", "grid:2x1", "--runs", 3, "--cycles", 9, "--log", "run.mcap", "--picture", "p.svg")
    output = good("run", *words, folder=tmp_path)
    assert "log      run-001.mcap to run-003.mcap" in output
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "p.svg",
        *(f"run-00{number}.mcap" for number in (1, 2, 3)),
    ]
    pose = [read_log(tmp_path / f"run-00{number}.mcap").robots["khepera0"].pose[0] for number in (1, 2, 3)]
    assert [round(float(place[0]), 3) for place in pose] == [0.15, 0.45, 0.15]


def test_series_are_compared_and_drawn(tmp_path: Path) -> None:
    for name, seed in (("one", 1), ("other", 2)):
        words = ("run", "--start", "random", "--seed", seed, "--runs", "3", "--cycles", "9", "--save", name)
        good(*words, folder=tmp_path)
    output = good(
        "series", "one", "other", "--picture", "s.png", "--columns", "fitness,distance_m", folder=tmp_path
    )
    lines = output.splitlines()
    assert [line.split()[0] for line in lines[1:4]] == ["fitness", "other", "less"]
    assert lines[-1] == "picture  s.png"
    assert (tmp_path / "s.png").read_bytes().startswith(b"\x89PNG")
    for words, line in (
        (("one", "none"), "none: no series here, as it has no series.json; to make one: "),
        (
            ("one", "--columns", "fitnes"),
            "column fitnes: not a number in these runs; did you mean 'fitness'?",
        ),
        (("one", "--picture", "s.jpg"), "--picture s.jpg: expected a name that ends in"),
        (("one", "--picture", "no/s.png"), "--picture no/s.png: there is no directory no"),
    ):
        assert complaint("series", *words, folder=tmp_path).startswith(line)


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        ("--resume", "--resume continues a saved series; expected --save FOLDER with it"),
        ("--save s --resume", "s: no series to resume; expected a folder that --save made"),
        ("--start 5,5,0", "start 5,5,0: robot 1 at (5, 5) overlaps the left wall"),
        ("--start playpen --robot 3", "robot = 3: not in playpen 'default'; (choices: 0)"),
        ("--lighting dark", "lighting 'dark': unknown; (choices: all, random, sequenced, off)"),
        ("--without-lamp 1", "--without-lamp 1: expected X,Y in mm, such as 50,450"),
        ("--without-lamp 1,1", "default: no lamp is left; expected one to take away or move"),
        ("--port khep://default --start random", "--start is for a twin in this process, not for one"),
        ("--pause inf", "a pause of inf s; expected 0 or more"),
        ("--save mine.py", "mine.py: no folder can be made here: File exists"),
    ],
)
def test_a_mistake_is_one_line(typed: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(PLAIN)
    assert complaint("run", "--cycles", "1", *typed.split(), folder=tmp_path).startswith(line)


def test_a_new_controller_runs_as_it_stands(tmp_path: Path) -> None:
    assert "khep-twin run mine.py" in good("new", "controller", "mine.py", folder=tmp_path)
    good("run", "mine.py", "--playpen", "obstacles", "--seconds", "20", "--save", "s", folder=tmp_path)
    assert int(rows(tmp_path / "s")[0]["turns"]) >= 1
    assert complaint("new", "controller", "mine.py", folder=tmp_path).startswith("mine.py: is there already")
    assert complaint("new", "controller", "mine.txt", folder=tmp_path).startswith("mine.txt: expected a name")


def test_a_new_controller_of_a_model_runs_in_the_playpen_of_its_message(tmp_path: Path) -> None:
    line = good("new", "controller", "mine.py", "--model", "khepera4", folder=tmp_path)
    assert "khep-twin run mine.py --playpen arena4" in line
    good("run", "mine.py", "--playpen", "arena4", "--seconds", "1", folder=tmp_path)
    refused = complaint("new", "toolbox", "it.py", "--model", "khepera4", folder=tmp_path)
    assert refused.startswith("--model khepera4: is for a controller")


@pytest.mark.parametrize("kind", [("run",), ("rollout", "--planar", "--period", "20")])
def test_a_model_is_run_without_an_edit_of_the_playpen(tmp_path: Path, kind: Sequence[str]) -> None:
    second = khep_twin(*kind, "--model", "khepera2", "--seconds", "0.2", folder=tmp_path)
    assert (second.returncode, second.stderr) == (0, "")
    refused = khep_twin(*kind, "--model", "khepera5", folder=tmp_path)
    assert refused.stderr == (
        "khep-twin: model = 'khepera5': unknown; did you mean 'khepera4'? "
        "(choices: khepera1, khepera2, khepera3, khepera3-firmware2, khepera4)\n"
    )


@pytest.mark.parametrize("kind", [("run",), ("rollout", "--planar", "--period", "20")])
def test_the_firmware_of_a_khepera_2_alone_is_reported_in_one_line(
    tmp_path: Path, kind: Sequence[str]
) -> None:
    process = khep_twin(*kind, "--rom", "khepera2", "--seconds", "0.2", folder=tmp_path)
    assert process.returncode == 0
    assert process.stderr == (
        "khep-twin: --rom khepera2 changes the firmware only: body and sensors stay a Khepera 1's; "
        "--model khepera2 changes all three\n"
    )
    assert khep_twin(*kind, "--rom", "4.06", "--seconds", "0.2", folder=tmp_path).stderr == ""


def test_starts_have_room_for_the_body_that_is_run(tmp_path: Path) -> None:
    words = ("run", "--start", "29,250,0", "--seconds", "0.1")
    assert khep_twin(*words, folder=tmp_path).returncode == 0
    assert "start 29,250,0" in khep_twin(*words, "--model", "khepera2", folder=tmp_path).stderr


TOOLBOX = """
from khep_twin.toolbox import *
btmap1 = open_custom("two-lamps", noise=False)
total = 0
def brait(port_id, cycles_per_run, runs, pause_stat):
    global total
    run_count = 0
    while run_count < runs:
        cycle_count = 0
        while cycle_count < cycles_per_run:
            near = max(rps(2))
            sms(port_id, 5, -5 if near > 300 else 5)
            cycle_count = cycle_count + 1
            total = total + 1
        run_count = run_count + 1
    return near, port_id
def samp(port_id, cycles_per_run, runs, pause_stat):
    for run in range(runs):
        for cycle in range(cycles_per_run):
            sim_sms(2, 5, 5)
            light = sim_rls(2)
            step()
def step():
    kheprom(btmap1)
def user1():
    print("user1")
def user2(near, total):
    print("user2", near, total)
"""


def test_a_function_in_the_toolboxs_form_is_run_in_a_series(tmp_path: Path) -> None:
    (tmp_path / "tb.py").write_text(TOOLBOX)
    words = (*ACROSS, "--pause", "1", "--save", "kept", "--on-run-end", "tb.py:user2", "--log", "run.mcap")
    output = good("run", "tb.py:brait", *words, folder=tmp_path)
    saved = rows(tmp_path / "kept")
    assert [row["total"] for row in saved] == ["60", "120", "180", "240"]
    assert [row["cycle_count"] for row in saved] == ["60"] * 4
    assert all(float(row["fitness"]) > 0 for row in saved)
    assert [f"user2 {row['near']} {row['total']}" in output for row in saved] == [True] * 4
    variables = loadmat(tmp_path / "kept" / "run-002.mat")
    assert variables["near"].item() == variables["var1"].item()
    texts = [line.text for line in read_log(tmp_path / "run.mcap").events]
    assert [text for text in texts if text.startswith("run 2")] == ["run 2 begins", "run 2 ends"]
    assert good("run", "tb.py:brait", *words, "--resume", folder=tmp_path).count("as before") == 4


def test_a_function_for_the_toolboxs_simulator_is_run_in_its_own_playpen_or_another(tmp_path: Path) -> None:
    (tmp_path / "tb.py").write_text(TOOLBOX)
    words = ("run", "tb.py:samp", "--cycles", 40, "--save")
    error = good(*words, "own", "--on-run-end", "tb.py:user1", folder=tmp_path)
    assert "40 cycles in 2.0 s" in error
    assert "user1" in error
    # The lamps of two-lamps are seen; in the dark default there are none.
    good(*words, "dark", "--playpen", "default", folder=tmp_path)
    lit_minimum, dark = (loadmat(tmp_path / name / "run-001.mat")["light"].min() for name in ("own", "dark"))
    assert lit_minimum < dark - 20
    error = complaint("run", "tb.py:samp", "--seconds", 5, folder=tmp_path)
    assert "samp: counts its cycles; expected cycles, no seconds" in error


def test_a_function_in_the_toolboxs_form_is_stopped_in_the_middle_of_its_run(tmp_path: Path) -> None:
    (tmp_path / "tb.py").write_text(TOOLBOX)
    words = ("tb.py:brait", "--cycles", 100, "--runs", 5000, "--save", "series")
    with started(tmp_path, *words) as process:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "runs are saved" in errors


def test_a_template_in_the_toolboxs_form_runs_as_it_stands(tmp_path: Path) -> None:
    assert "--cycles 500" in good("new", "toolbox", "mine.py", folder=tmp_path)
    assert "30 cycles" in good("run", "mine.py:name", "--cycles", 30, folder=tmp_path)


BAD_END = """
class Own(BaseException):
    def __str__(self):
        return "first\\n  second" if self.args else 1 / 0

def controller(robot):
    robot.set_speed(5, 5)
    if robot.time > 0.1:
        {}

def after(run):
    {}
"""


@pytest.mark.share(2)
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("raise GeneratorExit", "GeneratorExit"),
        ("raise GeneratorExit('mine')", "GeneratorExit: mine"),
        ("raise SystemExit(0)", "SystemExit: 0"),
        ("raise KeyboardInterrupt", "KeyboardInterrupt"),
        ("raise StopIteration(3)", "StopIteration: 3"),
        ("raise Own('mine')", "Own: first; second"),
        ("raise Own", "Own: (its text fails: ZeroDivisionError)"),
    ],
)
@pytest.mark.parametrize("where", ["cycle", "after"])
def test_whatever_a_controller_raises_is_its_fault_and_its_log_is_whole(
    text: str, message: str, where: str, tmp_path: Path
) -> None:
    parts = (text, "pass") if where == "cycle" else ("pass", text)
    (tmp_path / "mine.py").write_text(BAD_END.format(*parts))
    line = 9 if where == "cycle" else 12
    words = ("run", "mine.py:controller", "--on-run-end", "mine.py", "--cycles", "20", "--log", "run.mcap")
    result = khep_twin(*words, folder=tmp_path)
    assert result.returncode == 1
    assert result.stderr == f"khep-twin: {tmp_path / 'mine.py'}:{line}: {message}\n"
    assert [line.text for line in read_log(tmp_path / "run.mcap").robots["khepera0"].serial][-2:] == [
        "D,0,0",
        "d",
    ]
    assert {path.name for path in tmp_path.iterdir()} == {"mine.py", "run.mcap"}


@pytest.mark.parametrize("when", ["import os; os.chdir('away')", ""])
def test_files_lie_where_they_were_typed_wherever_a_controller_goes(when: str, tmp_path: Path) -> None:
    (tmp_path / "here" / "away" / "away").mkdir(parents=True)
    folder = tmp_path / "here"
    (folder / "goes.py").write_text(
        f"{when}\nimport os\n\ndef controller(robot):\n"
        "    os.path.isdir('away') and os.chdir('away')\n    robot.set_speed(5, 5)\n"
    )
    (folder / "then.py").write_text("def after(run):\n    open('own', 'w').close()\n")
    (folder / "mine.toml").write_text((toml_files.folder("calibration") / "khepera1.toml").read_text())
    text = dump(Playpen.load("default"))
    (folder / "arena.toml").write_text(text.replace('calibration = "khepera1"', 'calibration = "mine.toml"'))
    assert "mine.toml" in (folder / "arena.toml").read_text()
    words = ("--playpen", "arena.toml", "--start", "playpen", "--runs", "2", "--cycles", "3")
    files = ("--on-run-end", "then.py", "--log", "run.mcap", "--picture", "run.png", "--save", "series")
    output = good("run", "goes.py", *words, *files, folder=folder)
    assert output.splitlines()[-3].startswith("picture  run.png")
    assert output.splitlines()[-2].startswith("log      run-001.mcap to run-002.mcap")
    assert output.splitlines()[-1].startswith("series   series ")
    new_files = {"run-001.mcap", "run-002.mcap", "run.png", "series"}
    typed = {"goes.py", "then.py", "arena.toml", "mine.toml", "away"}
    assert {path.name for path in folder.iterdir()} == typed | new_files
    assert len(rows(folder / "series")) == 2
    assert (folder / "away" / "away" / "own").exists()
    assert read_log(folder / "run-002.mcap").robots["khepera0"].serial


def test_a_picture_without_its_package_is_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    files = ("--log", "run.mcap", "--picture", "run.png")
    assert complaint("run", "--cycles", 5, *files, folder=tmp_path).startswith("matplotlib is not installed;")
    assert "matplotlib is not" in complaint(
        "challenge", "show", "stop", "--picture", "s.png", folder=tmp_path
    )
    assert not [*tmp_path.iterdir()]


def test_a_fork_of_a_controller_leaves_the_log_whole(tmp_path: Path) -> None:
    (tmp_path / "forks.py").write_text(
        "import os\nforked = []\ndef controller(robot):\n    if not forked:\n"
        "        forked.append(os.fork())\n    robot.set_speed(3, 3)\n"
    )
    # Longer than the time between two pieces of the log; the fork goes on with the same run.
    words = "run", "forks.py", "--playpen", "default", "--seconds", "8", "--log", "run.mcap"
    process = subprocess.run([*PROGRAM, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert good("repeat", "run.mcap", folder=tmp_path).startswith("identical: 8.")


def test_cycles_that_take_longer_than_their_bytes_are_reported_once(tmp_path: Path) -> None:
    """A busy machine's replies come late; a stand-in's by a delay that is far above the line's times."""
    with FakeRobot() as robot:
        robot.delay = 0.02
        words = ("run", "--port", robot.url, "--baudrate", "115200", "--cycles", "2", "--runs", "2")
        result = khep_twin(*words, folder=tmp_path)
    assert result.returncode == 0, result.stderr
    notice = r"khep-twin: cycles took \d+ ms on average; expected 4 ms: this machine, the twin's or .*\n"
    assert re.fullmatch(notice, result.stderr), result.stderr
    with FakeRobot() as robot:
        result = khep_twin(*words[:2], robot.url, "--baudrate", "300", "--cycles", "1", folder=tmp_path)
    assert result.stderr == ""
