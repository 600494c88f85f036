"""Scenario of sweeps: workers that die, results that come late and twice, sweeps that are killed and resumed.

A user starts sweep after sweep, each with --resume until its table is there, now and then a second one of the
same output, and follows the instructions of error lines. Rollouts are run once for each task and remembered.
"""

import fcntl
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import khep_twin.process.status_line  # noqa: F401 - before a simulation: compilation reports by it
from checks.simulate import sweep_disk
from checks.simulate.kernel import NS_PER_S, OpenFile, Process
from checks.simulate.simulation import Simulation
from checks.simulate.sweep_mutants import MUTANTS as MUTANTS
from checks.simulate.workers import SimulatedRay, pool
from khep_twin.sweep import ray_workers, shards, study, sweep
from khep_twin.sweep.ray_workers import on_ray
from khep_twin.sweep.run_shard import run_shard
from khep_twin.sweep.shards import Shard, Work
from khep_twin.sweep.sweep import Executor, run_locally, run_sweep

MOST_KILLED, MOST_TWO = 1.0, 0.5
"""Highest probabilities that a sweep is killed, and that a second one is started beside it."""

MOST_CALLS = 3000
"""Most calls of a sweep that is killed; a whole one has about a thousand (measured)."""

MOST_TRIES = 300
"""Most starts of one sweep, after which it counts as one that never ends (assumed)."""

_STUDIES: Mapping[str, str] = {
    "one": 'controllers = ["braitenberg"]\nseeds = 3\nrollouts_per_task = 3\n',
    "many": 'controllers = ["braitenberg"]\nseeds = 24\nrollouts_per_task = 2\n',
    "mixed": 'controllers = ["braitenberg"]\nseeds = 5\nrollouts_per_task = 3\n'
    '[grid]\nnoise = [true, false]\n[[program]]\nname = "mine"\nfile = "mine.py:steer"\n'
    '[[measure]]\nname = "east"\nfile = "mine.py:east"\n',
}
"""Parts of the studies that differ: of one task, of many, and of tasks of several kinds."""

_PROGRAM = (
    "def steer(proximity, ambient, memory, genes):\n    return 5.0, 5.0 - proximity[0] * 0.01\n\n\n"
    "def east(numbers, registers, pose):\n    return pose[0]\n"
)

_EXPECTED = {
    "two": re.compile("in use by another sweep; wait for its end$"),
    "started": re.compile("holds results of this study already; expected --resume, or a new folder$"),
    "full": re.compile("No space left on device"),
    "torn": re.compile(
        r"^(.*\.parquet): (does not hold episodes .*; delete it, and use --resume|damaged; .*)$"
    ),
    "lost": re.compile("^ray: The cluster is gone; finished tasks are kept for --resume$"),
    "away": re.compile("^ray: no cluster can be joined at auto: "),
    "deadly": re.compile("has lost its worker 31 times"),
}
"""Lines that a sweep may end with, by their cause."""


def sweeps(simulation: Simulation, seconds: float) -> None:
    """Run sweeps for so many seconds."""
    for name in _STUDIES:
        _prepared(name)
    with _quick(), sweep_disk.installed(simulation), patch.dict(os.environ):
        ray = SimulatedRay(simulation)
        with patch.dict(sys.modules, {"ray": ray, "ray.exceptions": ray.exceptions}):
            user = User(simulation, ray)
            simulation.spawn("user", user.work)
            simulation.run(seconds)


class User:
    """User who starts sweeps and checks their results.

    Args:
        simulation: Simulation.
        ray: Its Ray.
    """

    def __init__(self, simulation: Simulation, ray: SimulatedRay) -> None:
        self._simulation, self._ray = simulation, ray
        self._ended = OpenFile(simulation.kernel)
        self._rng = simulation.rng("user")
        self._descriptors = _open()
        self._n_sweeps = 0

    def work(self) -> None:
        """Run study after study."""
        number = 0
        while True:
            number += 1
            name = self._rng.choice([*_STUDIES])
            folder = self._simulation.folder / f"sweep-{number}"
            self._study(name, folder)
            shutil.rmtree(folder)
            self._pause(self._rng.uniform(0.1, 5))

    def _study(self, name: str, folder: Path) -> None:
        """Start a study's sweep until its table is there."""
        simulation, faults = self._simulation, self._simulation.faults
        completed: set[int] = set()
        torn: set[str] = set()
        for tries in range(MOST_TRIES):
            runs = [self._run(name, folder, completed, torn, tries > 0 and self._rng.random() < 0.95)]
            if faults.happens("two", "sweeps", MOST_TWO):
                self._pause(faults.drawn("two", "sweeps").uniform(0, 3))
                runs.append(self._run(name, folder, completed, torn, True))
            simulation.kernel.wait(
                [self._ended], lambda runs=runs: not any(run.process.alive for run in runs), None
            )
            self._check_remains(folder)
            if not any(run.is_killed for run in runs) and (new := _parts(folder) - runs[0].parts):
                simulation.violate("leftovers", f"a sweep that was not killed has left {min(new)}")
            for run in runs:
                self._check_end(run, runs, folder, completed)
            if any(run.is_done for run in runs):
                self._check_table(name, folder)
                return
            torn |= {*sweep_disk.tear(simulation, folder)}
            self._pause(self._rng.uniform(0.1, 2))
        simulation.violate("results", f"the sweep does not end in {MOST_TRIES} starts")

    def _run(self, name: str, folder: Path, completed: set[int], torn: set[str], resume: bool) -> "Run":
        """Start a sweep."""
        simulation, faults = self._simulation, self._simulation.faults
        self._n_sweeps += 1
        executor = {
            "ray": lambda: on_ray("auto"),
            "pool": lambda: pool(simulation, self._ray.clusters),
            "local": run_locally,
        }[self._rng.choice(["ray", "ray", "pool", "pool", "local"])]
        run = Run(simulation, name, folder, completed, torn, resume)
        run.process = simulation.spawn(f"sweep {self._n_sweeps}", lambda: run.work(executor()))
        if faults.happens("sweep-killed", "sweep", MOST_KILLED):
            run.process.calls_left = round(MOST_CALLS ** faults.drawn("sweep-killed", "sweep").random())
        run.process.on_end = lambda process: self._end(process, run)
        return run

    def _end(self, process: Process, run: "Run") -> None:
        run.is_killed = process.dying
        self._ray.left(process)
        self._simulation.check_end(process)
        self._ended.changed()

    def _check_end(self, run: "Run", runs: list["Run"], folder: Path, completed: set[int]) -> None:
        """Check that an error line has its cause, and follow its instruction."""
        if run.is_killed:
            self._simulation.count("sweeps killed")
            return
        if run.is_done:
            return
        if not run.process.output_lines:
            self._simulation.violate("errors", f"{run.process.name} has ended without a table and a line")
        text = run.process.output_lines[-1][1]
        causes = {fault.partition("/")[0] for fault in self._simulation.faults.happened[run.n_faults :]}
        if len(runs) > 1:
            causes.add("two")
        if not run.resume and (completed or (folder / "results.parquet").exists() or run.began_with):
            causes.add("started")
        if run.torn:
            causes.add("torn")
        for cause, pattern in _EXPECTED.items():
            if cause in causes and (match := pattern.search(text)):
                if cause == "torn":
                    Path(match[1]).unlink(missing_ok=len(runs) > 1)  # both may ask for it
                    completed.clear()
                self._simulation.count("error lines")
                return
        self._simulation.violate("errors", f"{run.process.name} has ended without cause by: {text}")

    def _check_table(self, name: str, folder: Path) -> None:
        """Check a whole table, and that nothing is beside it."""
        if (folder / "results.parquet").read_bytes() != _prepared(name).table:
            self._simulation.violate("results", "the table is not that of a sweep that nothing disturbs")
        names = sorted(path.name for path in folder.iterdir())
        if names != ["results.parquet", "study.json"]:
            self._simulation.violate("leftovers", f"beside a whole table there is {' '.join(names)}")
        self._simulation.count("tables")

    def _check_remains(self, folder: Path) -> None:
        """Check that sweeps that have ended have left no descriptor, lock or worker."""
        if (descriptors := _open()) != self._descriptors:
            self._simulation.violate(
                "leftovers", f"{descriptors - self._descriptors} descriptors are left open"
            )
        if self._ray.clusters:
            self._simulation.violate("leftovers", "a sweep has left its workers")
        if folder.exists():
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                self._simulation.violate("leftovers", "a sweep has left its folder locked")
            finally:
                os.close(descriptor)

    def _pause(self, duration: float) -> None:
        kernel = self._simulation.kernel
        kernel.wait([], lambda: False, kernel.now_ns + round(duration * NS_PER_S))


class Run:
    """One start of a sweep.

    Attributes:
        process: Process of it.
        killed: True if it was killed.
        done: True if it has returned its table.
        resume: True if it was started with --resume.
        torn: True if files were torn before.
        n_faults: Number of faults that had happened before.
        began_with: True if there were results of tasks before.
        parts: Names of the unfinished files that were there before.
    """

    process: Process

    def __init__(
        self,
        simulation: Simulation,
        name: str,
        folder: Path,
        completed: set[int],
        torn: set[str],
        resume: bool,
    ) -> None:
        self._simulation, self._name, self._folder = simulation, name, folder
        self._completed, self._torn = completed, torn
        self.is_killed = self.is_done = False
        self.resume, self.torn = resume, bool(torn)
        self.n_faults = len(simulation.faults.happened)
        self.began_with = any(folder.glob("parts/*"))
        self.parts = _parts(folder)
        self._coming: Shard | None = None

    def work(self, executor: Executor) -> None:
        """Run the sweep, as the command does."""
        run_sweep(
            _prepared(self._name).file,
            output=self._folder,
            resume=self.resume,
            executor=self._watched(executor),
            begin=self._begin,
            progress=self._progress,
        )
        self.is_done = True

    def _begin(self, work: Work, missing: Sequence[Shard]) -> None:
        for task in missing:
            if task.index in self._completed and f"task-{task.index:06}.parquet" not in self._torn:
                self._simulation.violate("results", f"task {task.index} was kept, and is to be run again")
        self._simulation.count("tasks resumed", len(work.tasks) - len(missing))

    def _progress(self, n_done: int, total: int) -> None:
        assert self._coming is not None
        self._completed.add(self._coming.index)
        self._torn.discard(f"task-{self._coming.index:06}.parquet")

    def _watched(self, executor: Executor) -> Executor:
        @contextmanager
        def watched(work: Work, tasks: Sequence[Shard]) -> Generator[Iterable[tuple[Shard, bytes]]]:
            with executor(work, tasks) as coming:
                yield self._noted(coming)

        return watched

    def _noted(self, coming: Iterable[tuple[Shard, bytes]]) -> Iterator[tuple[Shard, bytes]]:
        for self._coming, data in coming:
            yield self._coming, data


@dataclass(frozen=True, slots=True)
class _Prepared:
    """A study that was read once, its work, and its table where nothing disturbs the sweep."""

    file: study.StudyFile
    work: Work
    table: bytes


@cache
def _prepared(name: str) -> _Prepared:
    """Return a study; its files are read immediately, as they vanish with the current simulation."""
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        (folder / "mine.py").write_text(_PROGRAM)
        (folder / "study.toml").write_text(
            f'version = 1\nname = "{name}"\nplaypens = ["default"]\nseconds = 0.02\nplanar = true\n'
            f'fitness = ["distance_m"]\noutput = "out"\n{_STUDIES[name]}'
        )
        file = study.load(folder / "study.toml")
        work = shards.work_of(file)
        _WORKS[work.digest] = work
        return _Prepared(file, work, run_sweep(file, output=folder / "out").read_bytes())


@contextmanager
def _quick() -> Generator[None]:
    """Run each task, and read each study, once; its results are remembered."""
    with ExitStack() as stack:
        for module in (sweep, ray_workers):
            stack.enter_context(patch.object(module, "run_shard", _remembered))
        stack.enter_context(patch.object(sweep, "work_of", _work))
        yield


@cache
def _of_digest(digest: str, index: int) -> Any:
    work = _WORKS[digest]
    return run_shard(work, work.tasks[index], 1)


def _remembered(work: Work, task: Shard, threads: int | None = 1) -> Any:
    return _of_digest(work.digest, task.index)


_WORKS: dict[str, Work] = {}


def _work(file: study.StudyFile) -> Work:
    return _prepared(file.study.name).work


def _parts(folder: Path) -> set[str]:
    """Return the names of unfinished files."""
    return {path.name for path in folder.rglob(".*.part*")}


def _open() -> int:
    """Return the number of the machine's descriptors that are open here."""
    return len(os.listdir("/proc/self/fd"))


SCENARIOS = {"sweep": sweeps}
