"""Fuzz targets run by libFuzzer (atheris), and shares of any target for the suite."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

import pytest


def fuzz(
    check: Callable[[bytes], None], seeds: Callable[[Path], None], modules: Sequence[str], *options: str
) -> None:
    """Fuzz with libFuzzer's own options from the command line; does not return.

    Args:
        check: use of one input; an exception is a find
        seeds: writes the inputs to begin with into a folder
        modules: modules that are imported, whose branches libFuzzer looks for, and those of their parts
        options: libFuzzer's, of this target
    """
    with tempfile.TemporaryDirectory(prefix="khep-twin-fuzz-") as corpus:
        # libFuzzer ends its process without a farewell: another one clears up.
        if child := os.fork():
            sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        atheris = import_module("atheris")
        for name in [name for name in sys.modules if name.startswith("khep_twin")]:
            del sys.modules[name]
        with atheris.instrument_imports(include=[*modules]):
            for name in modules:
                import_module(name)
        seeds(Path(corpus))
        atheris.Setup([*sys.argv, "-timeout=10", *options, corpus], check)
        atheris.Fuzz()


def run_libfuzzer(target: str, runs: int, folder: Path) -> None:
    """Run so many inputs of a libFuzzer target; fail with what it found, skip without atheris."""
    pytest.importorskip("atheris")
    done = run_target(target, f"-runs={runs}", "-seed=1", folder=folder)
    assert f"Done {runs} runs" in done.stderr


def run_target(target: str, *words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a fuzz target in a folder, return what it printed; fail with what it found."""
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name(target)), *words],
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done
