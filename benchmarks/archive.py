"""MAP-Elites here and in Kheperax, with the same number of evaluations: `python -m benchmarks.archive`.

Here it is `examples/05_map_elites.py` with its defaults, which needs ribs; there it is Kheperax's example
with qdax (`kheperax_archive`), in a separate process and Python. Coverage is the part of all cells of the
archive that have an elite. Both objectives go from 0, full speed all the time, to 1, a robot at rest, and the
QD score is their sum over all elites. Processor time has all threads; here also the start of Python and the
loading of compiled code, there only the search, with the compilation beside it.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks import peers
from khep_twin.errors import KhepTwinError

CELLS = 50
"""Cells along a side of the maze, as in Kheperax's example."""

_EXAMPLE = Path(__file__).parents[1] / "examples" / "05_map_elites.py"
_PEER = Path(__file__).with_name("kheperax_archive.py")


@dataclass(frozen=True, slots=True)
class Archive:
    """Results of one search.

    Attributes:
        name: Simulator.
        seed: Seed of the search.
        cpu: Processor time [s].
        objectives: Objectives of all elites (n,).
        compiling: Processor time of compiling, not in `cpu` [s].
    """

    name: str
    seed: int
    cpu: float
    objectives: Sequence[float]
    compiling: float = 0.0

    def row(self, evaluations: int) -> str:
        """Return a row of the table."""
        return (
            f"{self.name:10}{self.seed:5}{self.cpu:8.0f} s{1000 * self.cpu / evaluations:8.2f} ms"
            f"{self.compiling:9.0f} s{100 * len(self.objectives) / CELLS**2:8.1f} %"
            f"{sum(self.objectives):10.0f}"
        )


def run_example(seed: int, iterations: int, batch: int) -> Archive:
    """Run the example.

    Raises:
        KhepTwinError: The example fails; its last line gives the reason.
    """
    with TemporaryDirectory() as folder:
        file = Path(folder) / "elites.npz"
        words = f"--seed {seed} --iterations {iterations} --batch {batch} --cells {CELLS} --judge 0".split()
        start_s = _children_s()
        _run_program("the example", [sys.executable, str(_EXAMPLE), *words, "--elites", str(file)])
        return Archive("khep_twin", seed, _children_s() - start_s, np.load(file)["objectives"].tolist())


def run_kheperax(python: str, seed: int, iterations: int, batch: int, sigma: float) -> Archive:
    """Run Kheperax's MAP-Elites.

    Raises:
        KhepTwinError: Kheperax fails; its last line gives the reason.
    """
    request = {"seed": seed, "iterations": iterations, "batch": batch, "cells": CELLS, "sigma": sigma}
    answer = json.loads(_run_program("Kheperax", [python, str(_PEER)], json.dumps(request)))
    return Archive("Kheperax", seed, answer["cpu"], answer["fitness"], answer["compiling"])


def compare(python: str | None, seeds: int, iterations: int, batch: int, sigma: float) -> Iterator[Archive]:
    """Yield the searches of each seed, in turn."""
    for seed in range(seeds):
        yield run_example(seed, iterations, batch)
        if python is not None:
            yield run_kheperax(python, seed, iterations, batch, sigma)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare MAP-Elites with that of Kheperax.")
    parser.add_argument("--kheperax", help=f"Python that can import Kheperax; also by {peers.VARIABLE}")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument(
        "--sigma", type=float, default=0.2, help="mutation in Kheperax; default as there, 0.2"
    )
    options = parser.parse_args()
    python = peers.kheperax_python(options.kheperax)
    if python is None:
        print(peers.ABSENT)
    evaluations = options.iterations * options.batch
    print(f"{evaluations} evaluations")
    print("simulator  seed  processor   per one  compiling  coverage  QD score")
    for archive in compare(python, options.seeds, options.iterations, options.batch, options.sigma):
        print(archive.row(evaluations), flush=True)


def _run_program(name: str, command: Sequence[str], text: str = "") -> str:
    """Run a program; return its output."""
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    process = subprocess.run(command, input=text, capture_output=True, text=True, env=env)
    if process.returncode:
        error_lines = process.stderr.strip().splitlines() or ["it printed nothing"]
        raise KhepTwinError(f"{name} failed: {error_lines[-1]}")
    return process.stdout


def _children_s() -> float:
    """Return the processor time of all processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    try:
        main()
    except KhepTwinError as error:
        sys.exit(str(error))
