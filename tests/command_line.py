"""`khep-twin` in this process, for what commands write: to start one takes a second of a processor."""

import re
import subprocess
import sys
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
    # In a fresh checkout the first compiled run is announced.
    told = re.sub(r"khep_twin: compiling with numba.*\n", "", errors.getvalue())
    return subprocess.CompletedProcess(words, code, out.getvalue(), told)


def told(*words: object) -> str:
    """Run a command that ends well; return what it prints."""
    done = khep_twin(*words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refusal(*words: object) -> str:
    """Return the one line with which a command refuses."""
    done = khep_twin(*words)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    return line.removeprefix("khep-twin: ")
