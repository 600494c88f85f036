"""Shipped challenges, their scores, and files that fail in many ways."""

import csv
import json
import os
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest
from command_line import good, khep_twin
from PIL import Image

from khep_twin.errors import ChallengeError, ControllerError, StoppedError
from khep_twin.lab.challenge import results
from khep_twin.lab.challenge.attempt import Attempt, score_file
from khep_twin.lab.challenge.challenge import load, names
from khep_twin.lab.challenge.results import score_files, table, to_csv
from khep_twin.lab.challenge.scoring import Score, score
from tools import tutorial

SHORT = """
version = 1
name = "short"
title = "Drive"
description = "Drive."
playpen = "default"
seconds = 2
runs = 2
metric = "distance_m"
better = "higher"
threshold = 0.05
"""

CHANCE = """
import random


def controller(robot):
    robot.set_speed(random.randint(3, 9), 3 + hash("robot") % 5)
    robot.proximity()
"""

# A file, and the start of its error message.
BROKEN = {
    "syntax": ("def controller(robot)\n    pass\n", "syntax.py:1: SyntaxError: expected ':'"),
    "exits": ("import sys\nsys.exit(3)\n", "exits.py:2: SystemExit: 3"),
    "ends": ("import os\nos._exit(7)\n", "ends.py: ended its process, with exit code 7"),
    "crashes": (
        "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n",
        "crashes.py: its process was ended by SIGSEGV",
    ),
    "divides": (
        "def controller(robot):\n    robot.proximity()\n    1 / 0\n",
        "divides.py:3: ZeroDivisionError: division by zero",
    ),
    "kills_its_parent": (
        "import os, signal, time\nos.kill(os.getppid(), signal.SIGKILL)\ntime.sleep(60)\n",
        "kills_its_parent.py: its process was ended by SIGKILL",
    ),
    "takes_much": ("x = bytearray(4 << 30)\n", "takes_much.py:1: MemoryError; expected at most 2 GiB"),
    "floods": (
        "print('x' * 3_000_000)\n",
        "floods.py: printed 0 lines; expected at most 2 MB of text",
    ),
    "idles": ("def controller(robot):\n    pass\n", "idles.py: controller: a cycle lets no time pass"),
    "signal": (
        "import os, signal\nos.kill(os.getpid(), signal.SIGRTMIN + 1)\n",
        "signal.py: its process was ended by signal 35",
    ),
    "zero": ("x = 1\n\0", "zero.py: SyntaxError: source code string cannot contain null bytes"),
    "nothing": ("x = 1\n", "nothing.py: no function 'controller' that takes a robot"),
}

SCORED = {
    "never_returns": "def controller(robot):\n    robot.set_speed(5, 5)\n    robot.sleep(9)\n",
    "returns": "def controller(robot):\n    robot.set_speed(10, 10)\n    robot.proximity()\n",
    "prints": "def controller(robot):\n    robot.proximity()\n    print('\\x1b[31mhello')\n",
    "swallows": (
        "def controller(robot):\n    try:\n        robot.proximity()\n    except Exception:\n        pass\n"
    ),
}


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    path = tmp_path / "short.toml"
    path.write_text(SHORT)
    return path


def test_a_program_that_reads_no_sensor_has_no_score_by_it(short: Path, tmp_path: Path) -> None:
    short.write_text(SHORT.replace('"distance_m"', '"proximity_max"'))
    (tmp_path / "blind.py").write_text("def controller(robot):\n    robot.set_speed(5, 5)\n")
    with pytest.raises(ControllerError, match=r"blind\.py: run 1 has no proximity_max; expected a program"):
        score(load(str(short)), str(tmp_path / "blind.py"), 1, 1)


def test_a_program_that_loops_by_itself_has_a_fitness(short: Path, tmp_path: Path) -> None:
    short.write_text(SHORT.replace('"distance_m"', '"fitness"'))
    challenge = load(str(short))
    step = "    robot.proximity()\n    robot.set_speed(8, 8)\n"
    (tmp_path / "cycle.py").write_text(f"def controller(robot):\n{step}")
    (tmp_path / "loop.py").write_text(f"def controller(robot):\n  while True:\n{step}")
    by_cycle, by_loop = (score(challenge, str(tmp_path / name), 1, 1) for name in ("cycle.py", "loop.py"))
    assert by_loop.value == pytest.approx(by_cycle.value, rel=0.02)


def test_runs_are_independent_of_each_other_in_modules_and_metrics(short: Path, tmp_path: Path) -> None:
    (tmp_path / "beside_it.py").write_text("calls = []\n")
    (tmp_path / "prog.py").write_text(
        "import random\n"
        "import sys\n"
        f"sys.path.insert(0, {str(tmp_path)!r})\n"
        "import beside_it\n"
        "beside_it.calls.append(1)\n"
        "reads = random.random() < 0.5\n"
        "def controller(robot):\n"
        "    if reads:\n"
        "        robot.proximity()\n"
        "    robot.set_speed(5 * len(beside_it.calls), 5)\n"
    )
    challenge = load(str(short))
    together = score(challenge, str(tmp_path / "prog.py"), 4, 1)
    alone = [score(challenge, str(tmp_path / "prog.py"), 1, seed).value for seed in range(1, 5)]
    assert list(together.runs) == alone
    assert "proximity_max" in together.metrics


def test_a_file_name_that_is_no_utf_8_has_its_row(short: Path) -> None:
    attempts = [Attempt("ren\udce9.py", None, "ren\udce9.py: ended", 0, "")]
    challenge = load(str(short)).challenge
    assert b"ren\\udce9" in to_csv(challenge, attempts)
    table(challenge, attempts).encode("utf-8")


def test_a_program_of_a_khepera_iv_has_a_score_and_is_stopped_amid_a_command(tmp_path: Path) -> None:
    (tmp_path / "four.toml").write_text(
        'version = 1\nname = "four"\ntitle = "Wander"\ndescription = "Wander."\nplaypen = "arena4"\n'
        'seconds = 0.5\nmetric = "wall_following"\nbetter = "higher"\n'
    )
    (tmp_path / "four.py").write_text("def controller(robot):\n    robot.wander()\n    robot.sleep(9)\n")
    file_score = score(load(str(tmp_path / "four.toml")), str(tmp_path / "four.py"), 1, 1)
    assert file_score.metrics["distance_m"] > 0
    assert 0 < file_score.metrics["brightness"] < 0.05  # without a lamp


# A quarter turn to one side at the end of a stem.
TURNS = """
state = "stem"


def controller(robot):
    global state
    near = robot.proximity()
    if state == "turn":
        robot.turn({angle})
        state = "arm"
    elif max(near.left_10, near.right_10) > 120:
        robot.set_speed(0, 0)
        state = "turn" if state == "stem" else state
    else:
        side = max(near.left_90, near.left_45) - max(near.right_90, near.right_45)
        turn = max(-3, min(3, side // 100))
        robot.set_speed(8 + turn, 8 - turn)
"""


def long_but(*short_names: str) -> list[Any]:
    """The names of all challenges; the suite runs only some of them."""
    return [pytest.param(name, marks=() if name in short_names else pytest.mark.long) for name in names()]


@pytest.mark.share(2)
@pytest.mark.parametrize("name", long_but("stop", "square"))
def test_a_shipped_challenge_has_a_solution_that_passes_with_its_score(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = load(name)
    challenge = file.challenge
    assert challenge.name == name
    with monkeypatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path])
        solution_score = score(file, str(file.solution), challenge.runs, challenge.seed)
    assert challenge.passes(solution_score.value)
    assert challenge.reference is not None
    if tutorial.same_numbers():
        assert f"{solution_score.value:.4g}" == f"{challenge.reference:.4g}"


@pytest.mark.parametrize("name", names())
def test_a_shipped_challenge_has_a_small_picture(name: str) -> None:
    picture = load(name).picture
    assert picture.stat().st_size < 20_000
    with Image.open(picture) as drawn:
        assert min(drawn.size) > 200


@pytest.mark.parametrize("name", long_but("stop"))
def test_a_robot_that_stands_does_not_pass_a_challenge(name: str, tmp_path: Path) -> None:
    (tmp_path / "stands.py").write_text("def controller(robot):\n    robot.sleep(1)\n")
    file = load(name)
    file_score = score(file, str(tmp_path / "stands.py"), 1, file.challenge.seed)
    assert file.challenge.passes(file_score.value) is False


@pytest.mark.long
@pytest.mark.parametrize(("angle", "found_in"), [(1.571, (2, 3)), (-1.571, (0, 1))], ids=["left", "right"])
def test_in_the_maze_a_program_that_turns_to_one_side_finds_the_goal_in_half_of_the_runs_and_fails(
    tmp_path: Path, angle: float, found_in: tuple[int, int]
) -> None:
    (tmp_path / "turns.py").write_text(TURNS.format(angle=angle))
    file = load("maze")
    file_score = score(file, str(tmp_path / "turns.py"), file.challenge.runs, file.challenge.seed)
    assert (
        tuple(run for run, value in enumerate(file_score.runs) if value < file.challenge.seconds) == found_in
    )
    assert file.challenge.passes(file_score.value) is False


@pytest.mark.long
def test_tables_made_by_one_and_by_two_processes_are_the_same_bytes(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "class"
    folder.mkdir()
    for number in range(2):  # the first one ends last
        (folder / f"p{number}.py").write_text(f"import time\ntime.sleep({0.4 * (1 - number)})\n{CHANCE}")
    outputs: list[tuple[str, str]] = []
    for jobs in (1, 2):
        monkeypatch.setenv("PYTHONHASHSEED", str(jobs))
        output = tmp_path / f"{jobs}.csv"
        output_text = good("challenge", "table", short, folder, "--jobs", jobs, "-o", output)
        outputs.append((output_text.partition("\ntable ")[0], output.read_text()))
    assert outputs[0] == outputs[1]
    row, _ = csv.DictReader(outputs[0][1].splitlines())
    assert float(row["run_1"]) != float(row["run_2"])
    assert float(row["score"]) == (float(row["run_1"]) + float(row["run_2"])) / 2


def test_attempts_that_are_stopped_leave_no_process(short: Path, tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        (tmp_path / f"{name}.py").write_text(
            "import os, time\nfrom pathlib import Path\n"
            "Path(__file__).with_suffix('.pid').write_text(str(os.getpid()))\ntime.sleep(600)\n"
        )
    files = sorted(tmp_path.glob("*.py"))
    with pytest.raises(StoppedError):
        score_files(load(str(short)), files, jobs=2, stop=lambda: len([*tmp_path.glob("*.pid")]) == 2)
    pids = [int(path.read_text()) for path in tmp_path.glob("*.pid")]
    assert len(pids) == 2
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.share(2)
@pytest.mark.parametrize(
    "broken",
    [["kills_its_parent"], [*BROKEN]],
    ids=["some", "all"],
)
def test_a_table_has_a_line_for_every_file_whatever_it_does(
    broken: Collection[str], short: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "class"
    folder.mkdir()
    for name, text in {**{name: BROKEN[name][0] for name in broken}, **SCORED}.items():
        (folder / f"{name}.py").write_text(text)
    output = good("challenge", "table", short, folder, "-o", tmp_path / "class.csv")
    rows = {
        row["participant"]: row for row in csv.DictReader((tmp_path / "class.csv").read_text().splitlines())
    }
    assert list(rows)[:2] == ["returns", "never_returns"]
    assert {*rows} == {*broken, *SCORED}
    for name in broken:
        assert rows[name]["note"].startswith(f"{folder}/{BROKEN[name][1]}")
        assert (rows[name]["rank"], rows[name]["score"]) == ("", "")
    assert rows["prints"]["note"].endswith("lines, the last: [31mhello")
    assert len(output.splitlines()) == len(rows) + 2


@pytest.mark.share(2)
@pytest.mark.parametrize(
    "text",
    [
        "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\ntime.sleep(600)\n",
        "def controller(robot):\n    while True:\n        pass\n",
    ],
    ids=["waits", "loops"],
)
def test_a_file_that_hangs_is_ended_and_has_a_line(short: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "hangs.py").write_text(text)
    attempt = score_file(load(str(short)), str(tmp_path / "hangs.py"), real_seconds=1)
    assert attempt.score is None
    assert "hangs.py: not finished after 1 s of real time; expected cycles that end" in attempt.reason


def test_what_a_file_starts_is_ended_with_it(short: Path, tmp_path: Path) -> None:
    (tmp_path / "starts.py").write_text(
        "import subprocess\nfrom pathlib import Path\n"
        "child = subprocess.Popen(['sleep', '600'])\n"
        "Path(__file__).with_suffix('.pid').write_text(str(child.pid))\n"
        "def controller(robot):\n    robot.proximity()\n"
    )
    assert score_file(load(str(short)), str(tmp_path / "starts.py"), runs=1).score is not None
    status = Path(f"/proc/{int((tmp_path / 'starts.pid').read_text())}/stat")
    deadline = time.monotonic() + 60
    while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < deadline, "it still runs"
        time.sleep(0.05)


def test_a_table_that_is_stopped_has_the_rows_that_are_done(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(
        file: object, files: list[Path], *, on_result: Callable[[Attempt, float], None], **_: Any
    ) -> None:
        on_result(Attempt(str(files[0]), Score(0.5, (0.5,))), 0.5)
        raise KeyboardInterrupt

    monkeypatch.setattr(results, "score_files", stopped)
    for name in ("one", "two"):
        (tmp_path / f"{name}.py").touch()
    completed = khep_twin("challenge", "table", short, tmp_path, "-o", tmp_path / "class.csv")
    assert completed.returncode == 130
    assert "one" in completed.stdout
    assert "one,0.5,yes" in (tmp_path / "class.csv").read_text()


def test_no_more_is_shown_of_what_a_file_prints_than_a_terminal_takes(short: Path, tmp_path: Path) -> None:
    (tmp_path / "prints.py").write_text("print('x' * 1_000_000)\n" + SCORED["returns"])
    completed = khep_twin("challenge", "run", short, tmp_path / "prints.py", "--runs", 1)
    assert completed.returncode == 0
    assert completed.stdout.count("x") == 200_000
    assert completed.stderr == "khep-twin: 800001 more bytes that it printed are not shown\n"


def test_run_prints_score_and_result_and_keeps_a_log(short: Path, tmp_path: Path) -> None:
    (tmp_path / "returns.py").write_text(SCORED["returns"])
    log = tmp_path / "run.mcap"
    output = good("challenge", "run", short, tmp_path / "returns.py", "--runs", 1, "--log", log)
    assert output.splitlines()[1].startswith("passed     at least 0.05 m")
    assert good("repeat", log).startswith("identical: 2.")
    (tmp_path / "prints.py").write_text(SCORED["prints"])
    completed = khep_twin("challenge", "run", short, tmp_path / "prints.py", "--runs", 1)
    assert completed.returncode == 4
    assert "failed     at least 0.05 m" in completed.stdout


def test_what_a_file_prints_is_shown_as_it_is_and_ends_its_line(short: Path, tmp_path: Path) -> None:
    (tmp_path / "prints.py").write_text(
        "printed = []\n\n\ndef controller(robot):\n    robot.set_speed(5, 5)\n    if not printed:\n"
        "        printed.append(print('x' + 99_999 * 'é', end=''))\n"
    )
    completed = khep_twin("challenge", "run", short, tmp_path / "prints.py", "--runs", 1)
    printed, score, *_ = completed.stdout.splitlines()
    assert printed == "x" + 99_999 * "é"
    assert score.startswith("score ")


def test_a_challenge_without_a_reference_solution_says_so(short: Path) -> None:
    completed = khep_twin("challenge", "run", short)
    assert completed.returncode == 2
    solution = short.with_suffix(".py")
    expected = f"{short}: has no reference solution {solution}; expected a FILE.py to score"
    assert completed.stderr == f"khep-twin: {expected}\n"


def test_penalties_and_goals_make_the_score(short: Path, tmp_path: Path) -> None:
    goal = "\n[[goal]]\nx_mm = 300\ny_mm = 300\nradius_mm = 5\n"
    penalty = '\n[[penalty]]\nmetric = "collisions"\neach = 2.0\n'
    text = SHORT.replace('"distance_m"', '"goal_s"').replace("higher", "lower")
    short.write_text(text.replace("seconds = 2", "seconds = 9") + goal + penalty)
    (tmp_path / "ahead.py").write_text(SCORED["returns"])
    file_score = score(load(str(short)), str(tmp_path / "ahead.py"), 1, 1)
    assert file_score.metrics["collisions"] == 1
    assert 0.5 < file_score.metrics["goal_s"] < 0.8  # 45 mm at 80 mm/s
    assert file_score.value == file_score.metrics["goal_s"] + 2


def test_a_run_that_begins_with_a_lamp_without_a_goal_has_no_score(tmp_path: Path) -> None:
    maze = load("maze")
    path = tmp_path / "maze.toml"
    path.write_text(maze.path.read_text().replace('lamp = "right"', 'lamp = "left"'))
    (tmp_path / "ahead.py").write_text(SCORED["returns"])
    with pytest.raises(
        ChallengeError, match=r"maze: a run begins with the lamps right on, and has no goal; "
    ):
        score(load(str(path)), str(tmp_path / "ahead.py"), 1, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('"distance_m"', '"speed"'), 'short.toml:9: metric = "speed": unknown; did you mean '),
        (
            ('"distance_m"', '"goal_s"'),
            'short.toml:9: metric = "goal_s": there is no goal; expected a [[goal]]',
        ),
        (("seconds = 2", "seconds = 0"), "short.toml:7: seconds = 0"),
        (('playpen = "default"', 'playpen = "gripper"\nobject = "tin"'), 'object = "tin": unknown; '),
        (
            ('playpen = "default"', 'playpen = "defautl"'),
            'short.toml:6: playpen = "defautl": no such file; expected the path of a file or a shipped name; '
            "did you mean 'default'?",
        ),
        (("runs = 2", 'starts = ["grid:0x3"]'), "short.toml:8: start 'grid:0x3'; expected grid:"),
        (
            ("threshold = 0.05", "[[goal]]\nx_mm = 1e308\ny_mm = 9\nradius_mm = 9"),
            "short.toml:12: goal 1: x_mm = 1e+308; expected a place in the arena, 0 to 600",
        ),
        (
            ("threshold = 0.05", '[[penalty]]\nmetric = "collision"\neach = 1'),
            'short.toml:12: penalty 1: metric = "collision": unknown; did you mean ',
        ),
        (
            ("threshold = 0.05\n", '[[goal]]\nx_mm = 9\ny_mm = 9\nradius_mm = 5\nlamp = "moon"\n'),
            'short.toml:15: goal 1: lamp = "moon": unknown; (choices: none)',
        ),
    ],
)
def test_an_invalid_challenge_is_refused_with_its_line(
    short: Path, change: tuple[str, str], message: str
) -> None:
    short.write_text(SHORT.replace(*change))
    with pytest.raises(ChallengeError) as error:
        load(str(short))
    assert message in str(error.value)


def test_list_and_show_describe_the_shipped_challenges(tmp_path: Path) -> None:
    listed = khep_twin("challenge", "list").stdout.splitlines()
    assert [line.split()[0] for line in listed] == names()
    assert len(names()) >= 5
    output = khep_twin("challenge", "show", "square", "--picture", tmp_path / "square.png").stdout
    assert "goal       within 15 mm of (300, 400)" in output
    assert (tmp_path / "square.png").read_bytes() == load("square").picture.read_bytes()
    assert json.dumps(load("square").challenge.model_dump())
