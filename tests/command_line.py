"""`khep-twin` in this process, for the output of commands: a new process costs a second of CPU time."""

import re
import subprocess
import sys
from collections.abc import Container
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import pytest

from khep_twin.cli.app import main


def khep_twin(*words: object, folder: Path | str = ".") -> "subprocess.CompletedProcess[str]":
    """Run a command in a folder; an error that would be a traceback is raised here."""
    out, errors, code = StringIO(), StringIO(), 0
    with (
        chdir(folder),
        pytest.MonkeyPatch.context() as patch,
        redirect_stdout(out),
        redirect_stderr(errors),
    ):
        patch.setattr(sys, "argv", ["khep-twin", *map(str, words)])
        patch.setattr(sys, "path", [*sys.path])
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    # In a fresh checkout a compilation is announced.
    compiling = r"khep_twin: (compiling with numba|numba compiles in the background).*\n"
    error_text = re.sub(compiling, "", errors.getvalue())
    return subprocess.CompletedProcess(words, code, out.getvalue(), error_text)


def good(*words: object, folder: Path | str = ".") -> str:
    """Run a command that ends well; return what it prints."""
    result = khep_twin(*words, folder=folder)
    assert result.returncode == 0, result.stderr
    return result.stdout


def refusal(*words: object) -> str:
    """Return the one line with which a command refuses, and does nothing."""
    result = khep_twin(*words)
    assert result.stdout == ""
    return line_of(result, codes=[1])


def complaint(*words: object, folder: Path | str = ".", codes: Container[int] = (1, 2)) -> str:
    """Run a command with a mistake; return the one line that it gets."""
    return line_of(khep_twin(*words, folder=folder), codes)


def line_of(result: "subprocess.CompletedProcess[str]", codes: Container[int] = (1, 2)) -> str:
    """Return the one line of a command that has failed, without its head."""
    assert result.returncode in codes, result.stdout
    assert result.stderr.startswith("khep-twin: "), result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr.removeprefix("khep-twin: ").rstrip()
