"""Random one-line faults in khep_twin, each of which the tests must see.

    python -m checks mutants --seed 1 --count 100
    python -m checks mutants --seed 1 --count 100 --record     record first which tests reach which lines

A mutant has a comparison turned, + for -, a condition negated, or a result None. It is killed if one of its
tests fails, or takes longer than 20 s. Its tests are those that reach its line, those of its folder and
the fastest first, in 30 s together. Each runs in a copy of the tree, uncompiled, so that the faults of
compiled functions are seen. Survivors are printed; the exit status is 1 if more than one in ten survives.
"""

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from queue import Queue

import coverage

from checks.mutants.mutation import SourceMutant, mutants_of
from checks.mutants.selection import BUDGET_S, Recorded, digest
from tools.command_table import ROOT, command_line

RECORDING = ROOT / "out" / "mutants"
"""Folder of the recording of the tests."""

MOST_SURVIVORS = 0.1
"""Largest share of mutants that may survive."""

LIMIT_S = 6 * BUDGET_S
"""Longest time of a mutant's tests on a busy machine [s]; a mutant without an end is killed."""

LEFT_OUT = ("tests/checks", "tests/studies", "tests/web/test_browser_run.py", "tests/test_docs_blocks.py")
"""Tests that run no mutants: of other programs, with a browser, or of many pages."""

KILLED, SURVIVED, UNTESTED = "killed", "survived", "untested"


def main() -> int:
    """Run mutants; return 1 below the expected rate."""
    parser = command_line(__doc__)
    parser.add_argument("--seed", type=int, default=1, help="selects the mutants")
    parser.add_argument("--count", type=int, default=100, help="number of mutants")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of copies of the tree")
    parser.add_argument("--record", action="store_true", help="record anew which tests reach which lines")
    options = parser.parse_args()
    return run(options, ROOT, RECORDING)


def run(options: argparse.Namespace, root: Path, recording: Path) -> int:
    """Run mutants of a tree; return 1 below the expected rate."""
    if options.record or not (recording / "outcomes.json").exists():
        record(root, recording, options.jobs)
    mutants = draw(root, options.seed, options.count)
    with tempfile.TemporaryDirectory() as folder:
        trees: Queue[Path] = Queue()
        for number in range(max(options.jobs, 1)):
            trees.put(copy(root, Path(folder) / str(number)))
        recorded = Recorded(recording, Path(folder) / "0")
        choices = [(mutant, recorded.tests(mutant.path, mutant.line)) for mutant in mutants]

        def outcome_of(choice: tuple[SourceMutant, list[str]]) -> str:
            tree = trees.get()
            try:
                return outcome(tree, *choice)
            finally:
                trees.put(tree)

        n_survivors = 0
        with ThreadPoolExecutor(trees.qsize()) as pool:
            results = zip(choices, pool.map(outcome_of, choices), strict=True)
            for number, ((mutant, tests), result) in enumerate(results, 1):
                print(
                    f"\r{number} of {len(mutants)}, {n_survivors} survive",
                    end="",
                    file=sys.stderr,
                    flush=True,
                )
                if result == KILLED:
                    continue
                n_survivors += 1
                reach = "" if recorded.is_reached(mutant.path, mutant.line) else ", which do not reach it"
                original = (Path(folder) / "0" / mutant.path).read_text(encoding="utf-8")
                print(f"{mutant.path}:{mutant.line}: {mutant.fault}, {len(tests)} tests{reach}")
                print(mutant.diff(original), flush=True)
    print(f"seed {options.seed}: {len(mutants) - n_survivors} of {len(mutants)} mutants killed")
    return 1 if n_survivors > MOST_SURVIVORS * len(mutants) else 0


def draw(root: Path, seed: int, count: int) -> list[SourceMutant]:
    """Return mutants of a tree, the same for a seed."""
    paths = sorted(path for path in (root / "khep_twin").rglob("*.py") if "assets" not in path.parts)
    mutants = chain.from_iterable(
        mutants_of(path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")) for path in paths
    )
    candidates = list(mutants)
    return random.Random(seed).sample(candidates, min(count, len(candidates)))


def outcome(tree: Path, mutant: SourceMutant, tests: Sequence[str]) -> str:
    """Return whether tests kill a mutant in a copy of the tree."""
    if not tests:
        return UNTESTED
    path = tree / mutant.path
    original = path.read_text(encoding="utf-8")
    for stale in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
        stale.unlink()
    path.write_text(mutant.source(original), encoding="utf-8")
    try:
        # 1 is a failed test; 2 to 5 are errors of a collection, as of a module that cannot be imported.
        return KILLED if pytest(tree, ["-x", *tests], LIMIT_S, is_mutated=True) else SURVIVED
    except subprocess.TimeoutExpired:
        return KILLED
    finally:
        path.write_text(original, encoding="utf-8")


def record(root: Path, recording: Path, jobs: int) -> None:
    """Run the tests of a tree in a copy, and record which of them reach which lines."""
    shutil.rmtree(recording, ignore_errors=True)
    recording.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as folder:
        tree = copy(root, Path(folder) / "tree")
        left_out = [f"--ignore={path}" for path in LEFT_OUT]
        workers = ["-n", str(jobs), "--dist", "worksteal"] if jobs > 1 else []
        pytest(tree, [*workers, f"--record={recording}", *left_out, "tests"], None)
        lines = coverage.Coverage(str(recording / "lines"), config_file=False)
        lines.set_option("run:relative_files", True)
        lines.combine([str(path) for path in recording.glob("lines.*")])
        lines.save()
        sources = [*tree.rglob("*.py")]
        digests = {path.relative_to(tree).as_posix(): digest(path) for path in sources}
        (recording / "digests.json").write_text(json.dumps(digests))


def copy(root: Path, tree: Path) -> Path:
    """Copy the files of a tree that git does not ignore; return the copy."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=root, capture_output=True, check=True).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (root / name).is_file():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, tree / name)
    return tree


def pytest(tree: Path, words: Sequence[str], timeout_s: float | None, is_mutated: bool = False) -> int:
    """Run tests in a tree, uncompiled; return the exit status.

    Raises:
        subprocess.TimeoutExpired: They exceed the time limit.
    """
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(tree), str(ROOT)]),
        "NUMBA_DISABLE_JIT": "1",
        "TMPDIR": str(tree.parent),
    }
    if is_mutated:
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
    options = ["-q", "-p", "no:cacheprovider", "-p", "checks.mutants.plugin", "-o", "addopts=-m 'not long'"]
    options += ["--hypothesis-seed=0", *words]
    with open(tree.parent / f"{tree.name}.log", "wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *options],
            cwd=tree,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
        try:
            return process.wait(timeout_s)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, 9)
                process.wait()
