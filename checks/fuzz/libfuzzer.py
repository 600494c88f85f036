"""Runner of fuzz targets by libFuzzer (atheris), and of short runs in the test suite."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import pytest

from tools.command_table import ROOT, command_line

RUNS = 1_000_000
"""Inputs, where the command line does not say `-runs=N`."""


def fuzz(
    check: Callable[[bytes], None], seeds: Callable[[Path], None], modules: Sequence[str], *options: str
) -> None:
    """Fuzz with libFuzzer's options from the command line; does not return.

    Args:
        check: Use of one input; an exception is a finding.
        seeds: Function that writes the seed inputs into a folder.
        modules: Imported modules, whose branches libFuzzer looks for, with their submodules.
        options: Options of libFuzzer for this target.
    """
    about = f"{sys.modules[check.__module__].__doc__}\nAn option -help=1 lists those of libFuzzer."
    command_line(about).parse_known_args()
    with tempfile.TemporaryDirectory(prefix="khep-twin-fuzz-") as corpus:
        # libFuzzer ends its process without clean-up: another one does it.
        if child := os.fork():
            sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        atheris = import_module("atheris")
        for name in [name for name in sys.modules if name.startswith("khep_twin")]:
            del sys.modules[name]
        with atheris.instrument_imports(include=[*modules]):
            for name in modules:
                import_module(name)
        seeds(Path(corpus))
        atheris.Setup([sys.argv[0], f"-runs={RUNS}", "-timeout=10", *options, *sys.argv[1:], corpus], check)
        atheris.Fuzz()


def run_libfuzzer(target: str, runs: int, folder: Path) -> None:
    """Run so many inputs of a libFuzzer target; fail with its finding, skip without atheris."""
    pytest.importorskip("atheris")
    # By default libFuzzer runs its own new inputs once more after a second, which are runs beyond `runs`.
    process = run_target(target, f"-runs={runs}", "-seed=1", "-reload=0", folder=folder)
    assert f"Done {runs} runs" in process.stderr, process.stderr[-2000:]


def run_target(target: str, *words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a fuzz target in a folder; return its output, fail with its finding."""
    process = subprocess.run(
        [sys.executable, "-m", "checks", target, *words],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        timeout=300,
        check=False,
    )
    assert process.returncode == 0, process.stderr[-2000:]
    return process
