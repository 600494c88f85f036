"""Commands that messages ask to be pasted."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from khep_twin.process.invocation import command


@pytest.fixture
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an environment in `.venv`, in which nothing is on the path."""
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("khep-twin", "rerun"):
        (programs / name).write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
        (programs / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    monkeypatch.setattr(sys, "argv", ["mine.py"])
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    monkeypatch.chdir(tmp_path)
    return programs


def test_a_program_on_the_path_is_called_by_its_name_else_by_its_path(
    environment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert command("view", "a.mcap") == ".venv/bin/khep-twin view a.mcap"
    assert command("a.rrd", program="rerun") == ".venv/bin/rerun a.rrd"
    monkeypatch.chdir("/usr")
    assert command("ports") == f"{environment}/khep-twin ports"
    monkeypatch.chdir(environment)
    assert command("ports") == "./khep-twin ports"
    monkeypatch.setenv("PATH", f"{environment}:/bin")
    assert command("ports") == "khep-twin ports"


def test_another_installation_on_the_path_is_not_taken_for_this_one(
    environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other" / "khep-twin"
    other.parent.mkdir()
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    monkeypatch.setenv("PATH", str(other.parent))
    assert command("ports") == ".venv/bin/khep-twin ports"
    monkeypatch.setattr(sys, "argv", [str(other)])
    assert command("ports") == "khep-twin ports"


def test_what_is_pasted_into_a_shell_arrives_as_it_was(environment: Path) -> None:
    words = ["view", "b\udcfcse % \\n.mcap", "my log.mcap", "größe.mcap", "it's $HOME.mcap", "a;b", "a\tb"]
    process = subprocess.run(["sh", "-c", command(*words)], capture_output=True, check=True)
    assert os.fsdecode(process.stdout).splitlines() == words
    assert command(*words).isprintable() or "\t" in words[-1]
