"""The command line, as a user types it."""

import json
import os
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import chdir
from pathlib import Path

import mujoco
import pytest
from command_line import complaint, good, khep_twin, line_of
from forked import Forked, run_python
from typer.testing import CliRunner

from khep_twin import __version__
from khep_twin.cli.app import app
from khep_twin.files import toml_files
from khep_twin.log.reader import read_log
from khep_twin.process import invocation

GOOD = (toml_files.folder("playpens") / "obstacles.toml").read_text()


def process(
    *arguments: str | Path, before: Callable[[], None] | None = None
) -> "subprocess.CompletedProcess[str]":
    """A command in its own process, which calls `before` first."""
    words = [sys.executable, "-m", "khep_twin", *map(str, arguments)]
    if before is None:
        return run_python([*words], timeout=120)
    return subprocess.run(
        words,
        capture_output=True,
        text=True,
        timeout=120,
        preexec_fn=before,
    )


def test_the_version_and_the_help_come_at_once() -> None:
    assert process("--version").stdout == f"khep-twin {__version__}\n"
    assert "Run a controller on a twin or a robot, once or in a series." in process("--help").stdout
    program = (
        "import sys, khep_twin.cli; print([m for m in ('mujoco', 'rerun', 'matplotlib') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("frobnicate", "frobnicate: no such command; (choices: run, rollout, series, "),
        ("plaipen", "plaipen: no such command; did you mean 'playpen'? (choices: run, "),
        ("playpen chek", "chek: no such command; did you mean 'check'? (choices: list, check, "),
        ("rollout --plnar", "No such option: --plnar (Possible options: --planar, "),
        ("run --planar", "No such option: --planar"),
        ("run --period 40", "No such option: --period"),
        ("run --seconds abc", "Invalid value for '--seconds': "),
        ("run --seed", "Option '--seed' requires an argument"),
        ("conform", "Missing argument 'port'"),
        ("playpen random my.toml", "Got unexpected extra argument(s) (my.toml); expected -o my.toml"),
        ("playpen draw obstacles my.png", "Got unexpected extra argument(s) (my.png); expected -o my.png"),
        ("run braitenberg swarm", "Got unexpected extra argument(s) (swarm); expected --playpen swarm"),
        ("ports x", "Got unexpected extra argument(s) (x); expected khep-twin ports [OPTIONS], see "),
        (
            "new mine.py",
            "Invalid value for 'kind': Value error, 'mine.py' is not one of 'controller', 'toolbox'; see ",
        ),
        ("run -o x.mcap", "No such option: -o; see khep-twin run --help"),
        ("export a.mcap b.csv", "2 logs; expected -o b.csv for a table"),
        ("series nowhere", "nowhere: no series here, as it has no series.json; to make one: "),
        ("serve mine.py", "mine.py: no such file; expected the path of a file or a shipped name"),
    ],
)
def test_what_is_typed_wrong_gets_one_line(typed: str, message: str) -> None:
    assert complaint(*typed.split()).startswith(message)


def test_nothing_typed_gets_the_help() -> None:
    result = process()
    assert result.returncode == 2
    assert "Run a controller on a twin or a robot, once or in a series." in result.stderr


@pytest.mark.parametrize("group", [[], ["playpen"], ["challenge"]])
def test_the_list_of_commands_has_whole_sentences(group: list[str]) -> None:
    listed = CliRunner().invoke(app, [*group, "--help"]).stdout.partition("Commands:\n")[2].splitlines()
    assert len(listed) > 3
    assert [line for line in listed if not line.endswith(".") or line.endswith("...")] == []


def test_two_runs_with_one_seed_give_the_same_file_under_any_name(tmp_path: Path) -> None:
    logs = [tmp_path / "one.mcap", tmp_path / "sub" / "other-name.mcap", tmp_path / "third.mcap"]
    logs[1].parent.mkdir()
    for log, seed, command in zip(logs, (7, 7, 8), (khep_twin, process, khep_twin), strict=True):
        result = command("run", "--playpen", "obstacles", "--seconds", "3", "--seed", str(seed), "--log", log)
        assert result.returncode == 0, result.stderr
        assert f"look at it: {invocation.command('view', log)}" in result.stdout
    first, second, third = (log.read_bytes() for log in logs)
    assert first == second
    assert first != third


def test_a_run_draws_its_picture_and_leaves_nothing_half_written(tmp_path: Path) -> None:
    log, picture = tmp_path / "run.mcap", tmp_path / "run.png"
    good("run", "--seconds", "2", "--log", log, "--picture", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "run.png"]


def test_an_own_controller_is_run_for_its_cycles(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def turn(robot):\n    robot.set_speed(3, -3)\n    robot.sleep(0.1)\n")
    result = khep_twin("run", "mine.py:turn", "--cycles", "5", folder=tmp_path)
    first, *metrics = result.stdout.splitlines()
    assert first == "5 cycles in 0.6 s"
    measured, true = metrics[:2], metrics[2:]
    assert measured == ["fitness             0.09191", "speed mean          0 pulses/10 ms"]
    assert true[0] == "distance m          0"
    assert re.search(r"^coverage +0\.\d+ of the floor$", true[-1])


def test_a_log_becomes_a_rerun_recording(tmp_path: Path) -> None:
    log, recording = tmp_path / "run.mcap", tmp_path / "run.rrd"
    good("run", "--seconds", "2", "--log", log)
    good("view", log, "--save", recording)
    assert recording.read_bytes().startswith(b"RRF2")


def test_a_playpen_is_checked_compiled_and_drawn(tmp_path: Path) -> None:
    assert khep_twin("playpen", "check", "obstacles").stdout.startswith("obstacles: 8 blocks, 3 cylinders")
    scene = tmp_path / "scene.xml"
    assert khep_twin("playpen", "compile", "obstacles", "--output", scene).returncode == 0
    model = mujoco.MjModel.from_xml_path(str(scene))
    assert khep_twin("playpen", "compile", "obstacles").stdout == scene.read_text()
    assert model.body("khepera0/base").id > 0
    for name in ("arena.png", "arena.svg"):
        assert khep_twin("playpen", "draw", "obstacles", "-o", tmp_path / name).returncode == 0
    assert (tmp_path / "arena.svg").read_text().startswith("<?xml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["arena.png", "arena.svg", "scene.xml"]


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (("radius_mm", "radios_mm"), "radios_mm"),
        (("x_mm = 120", "x_mm = nan"), "x_mm = nan; expected a number from 0 to 10000"),
        (("x_mm = 120", "x_mm = 20"), "overlaps the left wall"),
        (("version = 1", "version = 1\n[arena"), "not TOML"),
    ],
)
def test_a_wrong_playpen_is_reported_file_table_key_and_value(
    change: tuple[str, str], line: str, tmp_path: Path
) -> None:
    file = tmp_path / "arena.toml"
    assert change[0] in GOOD
    file.write_text(GOOD.replace(*change, 1))
    for command in (["playpen", "compile", file, "-o", tmp_path / "scene.xml"], ["run", "--playpen", file]):
        result = khep_twin(*command)
        assert result.returncode == 1
        for error_line in result.stderr.splitlines():
            assert error_line.startswith(f"khep-twin: {file}:")
        assert line in result.stderr
    assert not (tmp_path / "scene.xml").exists()


@pytest.mark.parametrize(
    ("typed", "line"),
    [
        (
            "run --playpen obstacle",
            "obstacle: no such file; expected the path of a file or a shipped name; did",
        ),
        ("run --port /dev/nope --seconds 1", "/dev/nope: cannot open this port: "),
        ("run --port /dev/nope --log x.mcap", "--log is for a twin in this process"),
        ("run --picture x.png", "--picture draws the path from the log"),
        ("run --seconds 0", "--seconds and --cycles are above 0"),
        ("run --seed -1", "seed = -1; expected an integer from 0 to 2**63-1"),
        ("run --robot 1", "robot = 1: not in playpen 'default'; (choices: 0)"),
        ("run --log /nowhere/run.mcap", "/nowhere/run.mcap: cannot write a log here: "),
        ("run nobody.py", "nobody.py: no such file"),
        ("run nobody", "nobody: no such controller"),
        ("view nothing.mcap", "nothing.mcap: "),
        ("view a.mcap b.mcap --live", "--live follows one log, not 2"),
        ("view no/a.mcap --live", "no/a.mcap: no run writes this log"),
        ("view a.mcap --live --save a.rrd", "--save and --live cannot be combined"),
        ("view a.mcap --no-browser", "--no-browser is for --web"),
        ("view a.mcap --save b.mcap", "--save b.mcap: expected a name that ends in .rrd"),
        (
            "playpen compile default -o /nowhere/x.xml",
            "/nowhere/x.xml: cannot be written: there is no directory /nowhere",
        ),
        ("playpen draw default -o x.jpeg", "x.jpeg: expected a name that ends in .png, .svg or .pdf"),
    ],
)
def test_a_mistake_is_one_line_that_says_what_is_right(typed: str, line: str) -> None:
    assert complaint(*typed.split()).startswith(line)


@pytest.mark.parametrize(
    "typed",
    [
        "run --log mine",
        "run --runs 2 --start playpen --log series.mcap",
        "serve --log mine",
        "drive khep://default --log mine",
        "sense khep://default --linear 5 -o mine.csv",
        "fit a.mcap=998mm -o mine",
        "export a.mcap -o mine.csv",
        "export a.mcap --transcript mine.csv",
        "conform khep://default --report mine",
        "new controller mine.py",
        "playpen compile default -o mine",
        "playpen schema -o mine",
        "playpen random -o mine",
        "playpen import mine.png",
        "playpen draw mine.toml",
        "playpen draw default --perspective -o mine.png",
        "run --log a.mcap --picture mine.png",
        "rollout --picture mine.png",
        "branch a.mcap --at 1 --runs 2 -o mine.mcap",
        "series folder --picture mine.png",
        "sense khep://default --linear 5 --picture mine.png",
        "fit a.mcap=998mm --picture mine.png",
        "challenge show stop --picture mine.png",
        "report a.mcap -o mine.html",
        "view a.mcap --save mine.rrd",
        "view a.mcap --png mine.png",
    ],
)
def test_a_file_that_is_there_is_kept(typed: str, tmp_path: Path) -> None:
    kept_files = dict.fromkeys(
        ("mine", "mine.csv", "mine.py", "mine.png", "series-002.mcap"), "a year's work"
    )
    kept_files |= dict.fromkeys(("mine.html", "mine.rrd"), "a year's work")
    kept_files["mine.toml"] = GOOD.replace('name = "obstacles"', 'name = "mine"')
    for name, text in kept_files.items():
        (tmp_path / name).write_text(text)
    with chdir(tmp_path):
        result = CliRunner().invoke(app, typed.split())
    assert result.exit_code == 2, result.output
    expected = (
        r"khep-twin: (mine|series-002)\S*: is there already; expected another name, or --force to replace it"
    )
    assert re.fullmatch(expected, result.stderr.strip())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == kept_files


def test_a_file_is_replaced_by_force_or_where_it_is_empty(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    words = ["playpen", "compile", "default", "-o", str(file)]
    file.touch()
    assert CliRunner().invoke(app, words).exit_code == 0
    page = file.read_text()
    assert CliRunner().invoke(app, words).exit_code == 2
    file.write_text("another one")
    assert CliRunner().invoke(app, [*words, "--force"]).exit_code == 0
    assert file.read_text() == page


def test_the_readmes_run_can_be_repeated(tmp_path: Path) -> None:
    makefile = (Path(__file__).parents[2] / "Makefile").read_text()
    words = shlex.split(re.findall(r"@\$\(TWIN\) (run .*)", makefile)[0].replace("$(PLAYPEN)", "obstacles"))
    words[words.index("--seconds") + 1] = "0.5"
    (tmp_path / "out").mkdir()
    with chdir(tmp_path):
        for _ in range(2):
            assert CliRunner().invoke(app, words).exit_code == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run.mcap", "run.png"]


def test_a_full_disk_ends_the_run_and_keeps_what_was_written(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    line = line_of(
        process(
            *("run", "--seconds", "60", "--log", log),
            before=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000)),
        )
    )
    assert line.startswith(f"{log}: the log cannot be written any more at ")
    assert "File too large" in line
    assert line.endswith(f"what came before is kept in {log}.part")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]


@pytest.mark.share(2)
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_a_run_that_is_asked_to_end_ends_with_its_log_whole(how: signal.Signals, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "khep_twin", "run", "--seconds", "5000", "--log", str(log)]
    with Forked(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        part = tmp_path / "run.mcap.part"
        end = time.monotonic() + 60
        while not part.exists() or part.stat().st_size < 150_000:
            assert time.monotonic() < end, "nothing is written"
            time.sleep(0.05)
        process.send_signal(how)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + how
    assert errors.endswith("khep-twin: stopped before its end\n")
    assert "look at it" in output
    assert read_log(log).robots["khepera0"].times_ns[-1] > 10**9


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def controller(robot): raise ValueError('mine')", "mine.py:1: ValueError: mine"),
        ("def controller(robot): import sys; sys.exit(3)", "mine.py:1: SystemExit: 3"),
        ("def controller(robot): raise KeyboardInterrupt", "mine.py:1: KeyboardInterrupt"),
        ("raise KeyboardInterrupt", "mine.py:1: KeyboardInterrupt"),
        ("def controller(robot): pass", "a cycle lets no time pass"),
        ("def controller(robot): yield", "'controller' is no plain function"),
        ("async def controller(robot): ...", "'controller' is no plain function"),
        ("def controller(): ...", "'controller' takes ()"),
        ("def controller(robot): controller(robot)", "mine.py:1: RecursionError"),
    ],
)
def test_a_controller_that_fails_is_one_line(text: str, line: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(text + "\n")
    assert line in complaint("run", file, "--seconds", "1")


def test_options_of_a_twin_are_refused_for_a_port() -> None:
    for option in (["--seed", "3"], ["--playpen", "default"], ["--mode", "2"]):
        text = complaint("run", "--port", "khep://default", "--seconds", "1", *option)
        assert text == f"{option[0]} is for a twin in this process, not for one behind --port"


def test_a_picture_that_cannot_be_drawn_is_refused_before_the_run(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    for picture in (tmp_path / "run.gif", tmp_path / "no" / "run.png"):
        complaint("run", "--seconds", "5000", "--log", log, "--picture", picture)
    assert list(tmp_path.iterdir()) == []


def test_a_twin_conforms_and_says_so(tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    result = khep_twin("conform", "khep://default", "--report", report)
    assert result.returncode == 0, result.stdout
    assert "khep://default: 24 passed, 0 failed, 13 of turrets that are absent" in result.stdout
    assert result.stdout.count("skip  ") == 15
    assert json.loads(report.read_text())["passed"] is True


def test_unknown_options_are_refused_with_help() -> None:
    result = khep_twin("run", "--sed", "1")
    assert result.returncode == 2
    assert "No such option: --sed" in result.stderr


def test_a_warning_about_a_port_is_one_line() -> None:
    process = run_python([sys.executable, "-m", "khep_twin", "conform", "khep://default?mode=2"], timeout=60)
    assert len(process.stderr.splitlines()) == 1
    assert process.stderr.startswith("khep-twin: khep://default?mode=2: the host has its line at 9600 baud")


TEMPORARY = """
import os, sys, tempfile
def refuse():
    raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")
tempfile.gettempdir = refuse
sys.argv = ["khep-twin", *sys.argv[1:]]
from khep_twin.cli.app import main
main()
"""
"""The command line on a system where no folder for temporary files can be written."""


@pytest.mark.parametrize("words", ["ports", "exec true"])
def test_without_a_folder_for_temporary_files_a_command_ends_in_one_line(words: str, tmp_path: Path) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "XDG_RUNTIME_DIR"}
    result = run_python(
        [sys.executable, "-c", TEMPORARY, *words.split()], cwd=tmp_path, env=environment, timeout=60
    )
    expected = "no folder for temporary files can be written; expected one, which TMPDIR may name"
    assert (result.returncode, result.stderr.splitlines()[-1]) == (1, f"khep-twin: {expected}")
    assert "Traceback" not in result.stderr
