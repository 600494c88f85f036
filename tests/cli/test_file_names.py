"""Names of files that most programs do not expect: links in a circle, and bytes that are no text."""

import os
import re
import sys
from pathlib import Path

import pytest
from command_line import good, khep_twin
from forked import run_python

_CIRCLE = "Too many levels of symbolic links"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, and links that lead to themselves."""
    folder = tmp_path_factory.mktemp("names")
    good("run", "--seconds", "0.2", "--log", "good.mcap", folder=folder)
    for ending in ("toml", "py", "mcap", "png", "csv", "html", "xml"):
        (folder / f"loop.{ending}").symlink_to(f"loop.{ending}")
    return folder


@pytest.mark.share(6)
@pytest.mark.parametrize(
    "words",
    [
        "serve loop.toml",
        "serve --log loop.mcap",
        "serve --from loop.mcap",
        "run loop.py",
        "run --playpen loop.toml",
        "run --log loop.mcap",
        "run --log new.mcap --picture loop.png --seconds 0.1 --force",
        "run --on-run-end loop.py",
        "run --port khep://loop.mcap",
        "run --port khep://default?log=loop.mcap",
        "rollout loop.py",
        "rollout --log loop.mcap --seconds 0.1",
        "rollout --picture loop.png --seconds 0.1",
        "sweep loop.toml",
        "new controller loop.py --force",
        "design loop.toml --no-browser",
        "view loop.mcap --save x.rrd",
        "report loop.mcap -o x.html",
        "report good.mcap -o loop.html",
        "export loop.mcap -o x.csv",
        "export good.mcap -o loop.csv",
        "export good.mcap --transcript loop.csv",
        "recover loop.mcap",
        "repeat loop.mcap",
        "branch loop.mcap --at 0.1 -o x.mcap",
        "branch good.mcap --at 0.1 -o loop.mcap",
        "branch good.mcap --at 0.1 -o x.mcap --controller loop.py",
        "sense khep://loop.toml --linear 5 -o x.csv",
        "fit loop.csv=wall@22mm -o x.toml",
        "fit good.mcap=998mm -o loop.toml",
        "calibrate khep://default -o loop.toml",
        "conform loop.mcap",
        "playpen check loop.toml",
        "playpen draw obstacles -o loop.png",
        "playpen compile obstacles -o loop.xml",
        "playpen random -o loop.toml",
        "playpen import loop.png -o x.toml",
        "challenge run loop.toml",
        "challenge show stop --picture loop.png",
    ],
)
def test_a_link_that_leads_to_itself_is_one_line(words: str, folder: Path) -> None:
    result = khep_twin(*words.split(), folder=folder)
    assert result.returncode in (1, 2)
    assert re.fullmatch(f"khep-twin: .*loop.*{_CIRCLE}\n", result.stderr)
    left = {path.name for path in folder.iterdir() if not path.is_symlink()}
    assert left <= {"good.mcap", "new.mcap"}
    assert len([*folder.glob("loop.*")]) == 7


def test_a_name_whose_bytes_are_no_text_is_printed_as_a_shell_takes_it(tmp_path: Path) -> None:
    name = os.fsdecode(b"b\xfcse")
    (tmp_path / f"{name}.py").write_text("def controller(robot):\n    robot.set_speed(5, 5)\n")
    words = (
        sys.executable,
        "-m",
        "khep_twin",
        "run",
        f"{name}.py",
        "--seconds",
        "0.2",
        "--log",
        f"{name}.mcap",
    )
    result = run_python([*words], cwd=tmp_path, timeout=60, text=False)
    assert result.returncode == 0, result.stderr
    line = result.stdout.splitlines()[-1]
    assert line.startswith(b"log      b\xfcse.mcap ")
    assert line.endswith(b" view \"$(printf 'b\\374se.mcap')\"")
    good("branch", f"{name}.mcap", "--at", "0.1", "-o", f"{name}-2.mcap", folder=tmp_path)
    good("view", f"{name}.mcap", f"{name}-2.mcap", "--save", f"{name}.rrd", folder=tmp_path)
    assert (tmp_path / f"{name}.rrd").read_bytes().startswith(b"RRF2")
