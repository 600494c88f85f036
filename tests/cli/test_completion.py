"""Completion in the shell, and the choices where an argument is missing."""

import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from khep_twin import playpen
from khep_twin.cli.app import app, main
from khep_twin.host import discovery
from khep_twin.host.discovery import FoundPort

SHIPPED = playpen.names()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with files of each kind, on a machine with one cable and one served twin."""
    for name in ("mine.toml", "mine.py", "mine.mcap", "notes.txt"):
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    ports = [FoundPort("/tmp/twin", "twin in default", True), FoundPort("/dev/ttyUSB7", "USB serial", False)]
    monkeypatch.setattr(discovery, "found_ports", lambda: ports)
    return tmp_path


def complete(capsys: pytest.CaptureFixture[str], **variables: str) -> str:
    """Runs the command as a shell's completion does, by variables of the environment."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["khep-twin"])
        for name, value in variables.items():
            patch.setenv(name, value)
        with pytest.raises(SystemExit) as end:
            main()
    assert not end.value.code
    return capsys.readouterr().out


def in_bash(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    """Return the completions of the last of these words in bash."""
    line = "\n".join(["khep-twin", *words])
    variables = {"COMP_WORDS": line, "COMP_CWORD": str(len(words)), "_KHEP_TWIN_COMPLETE": "complete_bash"}
    return complete(capsys, **variables).split()


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("playpen check ", [*SHIPPED, "mine.toml"]),
        ("serve wall", ["wall-or-cylinder"]),
        ("run --playpen obst", ["obstacles"]),
        ("run ", ["braitenberg", "mine.py"]),
        ("fit --start khepera1", ["khepera1", "khepera1-manual"]),
        ("conform /", ["/tmp/twin", "/dev/ttyUSB7"]),
        ("drive /dev", ["/dev/ttyUSB7"]),
        ("sense kh", [f"khep://{name}" for name in SHIPPED]),
        ("run --port /tmp", ["/tmp/twin"]),
        ("view m", ["mine.mcap"]),
        ("sweep ", ["mine.toml"]),
        ("playpen draw ../", []),
    ],
)
def test_bash_is_reported_what_there_is(
    typed: str, offered: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert in_bash(capsys, *typed.split(" ")) == offered


def test_bash_completes_a_port_behind_its_colon(capsys: pytest.CaptureFixture[str]) -> None:
    assert in_bash(capsys, "conform", "khep", ":", "//ho") == ["//homing"]
    assert in_bash(capsys, "conform", "khep", ":") == [f"//{name}" for name in SHIPPED]
    assert in_bash(capsys, "run", "--port", "khep", ":", "//two-") == ["//two-lamps"]
    assert in_bash(capsys, "sense", "khep", ":", "//default", "--wh") == ["--what"]


def test_zsh_is_reported_what_there_is_and_what_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    variables = {"_TYPER_COMPLETE_ARGS": "khep-twin conform khep://d", "_KHEP_TWIN_COMPLETE": "complete_zsh"}
    output = complete(capsys, **variables)
    assert r'"khep\\://default":"Four walls and a robot' in output
    variables["_TYPER_COMPLETE_ARGS"] = "khep-twin playpen check elsewhere/"
    assert complete(capsys, **variables).strip() == "_files"


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("conform", "e.g. khep://default, or a log, FILE.mcap. (choices: "),
        ("playpen draw", f"(choices: {', '.join(SHIPPED)}, mine.toml)"),
        ("new", "(choices: controller, toolbox)"),
        ("view", "(choices: mine.mcap)"),
        ("new controller", "Missing argument 'FILE.py': File to write."),
    ],
)
def test_a_missing_argument_names_the_choices(
    typed: str, message: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["khep-twin", *typed.split()])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert errors.count("\n") == 1


def test_the_shipped_playpens_are_listed_a_line_each_as_in_their_guide() -> None:
    listed = CliRunner().invoke(app, ["playpen", "list"]).stdout.splitlines()
    descriptions = dict(re.split(r"  +", line, maxsplit=1) for line in listed)
    assert list(descriptions) == SHIPPED
    assert all(len(line) <= 100 for line in listed)
    guide = (Path(__file__).parents[2] / "docs" / "playpens.md").read_text()
    rows = dict(re.findall(r"^\| `([\w-]+)` \| (.*) \|$", guide.split("## The format")[0], re.MULTILINE))
    assert rows == {name: text[0].lower() + text[1:] for name, text in descriptions.items()}
