"""Scenario `record`: runs that record logs on a disk with faults, and all that is done with logs then."""

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from traceback import clear_frames

from checks.simulate.compiled_worlds import compiled_worlds
from checks.simulate.disk import Disk
from checks.simulate.kernel import NS_PER_S, Process
from checks.simulate.log_damage import damage
from checks.simulate.log_readings import read_in_every_way
from checks.simulate.log_truth import Truth
from checks.simulate.recorded_runs import Run
from checks.simulate.recording_mutants import MUTANTS as MUTANTS
from checks.simulate.simulation import Simulation
from khep_twin.errors import KhepTwinError, LogError
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_label, read_raw
from khep_twin.log.recorded import read_changes, read_recorded_run
from khep_twin.log.recover import Recovery, recover, summary
from khep_twin.log.tail import GrowingLog

NAMES = "a.mcap", "b.mcap"

_PART = re.compile(r"\.mcap\.part(\.[0-9]+)?$")

_BY_DISK = "No space left on device", "Input/output error", "Read-only file system", "File exists"
"""Reasons that a line about a failed log may give."""


def record(simulation: Simulation, seconds: float) -> None:
    """Let runs follow each other until the time is over."""
    lab = _Lab(simulation)
    end_ns = simulation.kernel.now_ns + round(seconds * NS_PER_S)
    with compiled_worlds():
        while simulation.kernel.now_ns < end_ns:
            lab.round()
    if not lab.disk.agrees():
        raise AssertionError("the simulated disk holds other files than the machine")


class _Lab:
    """Folder of logs, with the true content of their runs."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.disk = Disk(simulation)
        self._rng = simulation.rng("lab")
        self._truths: dict[int, Truth] = {}
        self._unfinished: dict[str, str] = {}
        self._checked: set[tuple[str, str]] = set()
        self._owners: dict[str, Truth | None] = {}
        self._rounds = self._runs = 0

    def round(self) -> None:
        """Let one run happen, or two of one name, and check the remaining files."""
        simulation, rng = self._simulation, self._rng
        self._rounds += 1
        cuts = self.disk.cuts
        runs = [self._run(rng.choice(NAMES))]
        path = runs[0].path
        processes = [self._start(runs[0], 0.0)]
        if simulation.faults.happens("second-run", path.name, 0.5):
            delay = simulation.faults.drawn("second-run", path.name).choice((0.0, 1e-4, 3.0))
            runs.append(self._run(path.name))
            processes.append(self._start(runs[-1], delay))
        tail: list[object] = []
        if rng.random() < 0.5:
            processes.append(simulation.spawn(f"tail{self._rounds}", lambda: self._tail(path, tail), 10**9))
        while any(process.alive for process in processes):
            simulation.run(1.0)
        simulation.run(rng.uniform(0.0, 30.0))
        if simulation.faults.happens("power-cut", "machine", 0.5):
            self.disk.cut()
        self._check_ends(runs, processes)
        self._check_folder(runs, cuts)

    def _run(self, name: str) -> Run:
        self._runs += 1
        number = self._runs
        self._truths[number] = truth = Truth(number)
        rng = self._simulation.rng("kind", number)
        run = Run(self._simulation, number, self._simulation.folder / name, truth, 10 ** rng.uniform(0, 1.5))
        run.goes_on = rng.random() < 0.5
        return run

    def _start(self, run: Run, delay: float) -> Process:
        rng = self._simulation.rng("start", run.number)
        kind: Callable[[], None] = rng.choice((run.lock_step, run.lock_step, run.served, run.relayed))
        parents = [path for path in sorted(self._simulation.folder.glob("*.mcap")) if path != run.path]
        if kind == run.lock_step and parents and rng.random() < 0.5:
            truth = self._truth_of(parents[0])
            if truth is not None and truth.last_ns > NS_PER_S and truth.samples:
                run.parent = parents[0]
        name = f"run{run.number}"
        process = self._simulation.spawn(name, kind, round(delay * NS_PER_S))
        process.mortal = True
        if self._simulation.faults.happens("kill-run", "machine", 1.0):
            kill_rng = self._simulation.faults.drawn("kill-run", "machine")
            after = kill_rng.choice((10 ** kill_rng.uniform(-3, 1.5), run.duration * kill_rng.random()))
            kernel = self._simulation.kernel
            kernel.at(kernel.now_ns + round((delay + after) * NS_PER_S), lambda: kernel.kill(process))
        return process

    def _truth_of(self, path: Path) -> Truth | None:
        """Return the truth of a log, by its seed, or by that with which it was branched off."""
        content = _hash(path)
        if content not in self._owners:
            self._owners[content] = self._owner(path)
        return self._owners[content]

    def _owner(self, path: Path) -> Truth | None:
        try:
            label = read_label(path)
        except LogError as error:
            if "no log of khep_twin" not in str(error):
                raise
            return None  # recovered, of a run that ended as it began
        seeds = [change.seed for change in read_changes(path, label)]
        return self._truths.get(seeds[-1] or 0 if seeds else int(label.metadata.get("seed", "0")))

    # While it is written -------------------------------------------------------------------------------

    def _tail(self, path: Path, messages: list[object]) -> None:
        """Follow a log while it is written."""
        sleep = self._simulation.system.modules["time"].sleep  # type: ignore[attr-defined]
        try:
            with GrowingLog(path) as log:
                while not log.is_finished:
                    messages += log.read_new()
                    sleep(0.5)
        except FileNotFoundError:
            return
        except LogError as error:
            if not any(
                phrase in str(error) for phrase in ("ended without finishing", "is finished", "damaged")
            ):
                raise
        self._simulation.count("messages followed", len(messages))

    # Afterwards ----------------------------------------------------------------------------------------

    def _check_ends(self, runs: list[Run], processes: list[Process]) -> None:
        """Check that a run that has failed has reported the reason in one line."""
        violate = self._simulation.violate
        for run, process in zip(runs, processes, strict=False):
            printed = [line for _, line in process.output_lines]
            lines = [*printed, *(run.failures or [])]
            if len(lines) > 1:
                violate("errors", f"run {run.number} reports {lines}")
            for line in lines:
                self._simulation.count("lines about logs")
                reasons = [*_BY_DISK, *["another run is writing it"] * (len(runs) > 1)]
                # One that was killed before its first step.
                reasons += ["the run ends at 0 s"] * (run.parent is not None)
                # A power cut may leave zeros under the name, which the next run does not touch.
                reasons += ["this is no unfinished log"] * (self.disk.cuts > 0)
                if not any(reason in line for reason in reasons):
                    violate("errors", f"run {run.number} reports {line!r}")
            if run.truth.closed and printed:
                violate("errors", f"run {run.number} was completed, and reports {printed}")

    def _check_folder(self, runs: list[Run], cuts: int) -> None:
        """Look at all files of the folder, after a round before which there were so many power cuts."""
        simulation, folder = self._simulation, self._simulation.folder
        parts = [path for path in sorted(folder.iterdir()) if _PART.search(path.name)]
        hashes = {_hash(path): path for path in parts}
        if self.disk.cuts == cuts:
            for content, name in self._unfinished.items():
                if content not in hashes:
                    simulation.violate("leftovers", f"the unfinished log that was {name} is gone")
        run_paths: dict[int, Path] = {}
        for path in parts:
            if (truth := self._recover(path, cuts)) is not None:
                run_paths[truth.number] = path
        for path in sorted(folder.glob("*.mcap")):
            if (truth := self._check(path)) is not None:
                run_paths.setdefault(truth.number, path)
        if self.disk.cuts == cuts:
            self._check_left(runs, parts, run_paths)
        self._clear(parts, cuts)

    def _check_left(self, runs: list[Run], parts: list[Path], run_paths: dict[int, Path]) -> None:
        """Check that the files which runs should leave are there, and no others."""
        simulation = self._simulation
        for run in runs:
            truth = run.truth
            if truth.closed and (left := run_paths.get(truth.number)) in parts:
                simulation.violate("leftovers", f"run {run.number} was completed, and left {left}")
            # One that was replaced by a later run of the name is the user's wish.
            replaced = any(other.truth.closing and other is not run for other in runs)
            if truth.last_ns >= 0 and truth.number not in run_paths and not (truth.closing and replaced):
                simulation.violate("recovery", f"nothing of run {run.number} is left")

    def _clear(self, parts: list[Path], cuts: int) -> None:
        """Remove some of the files, as a user does who needs them no more."""
        self._unfinished.clear()
        for part in parts:
            if self._rng.random() < 0.6:
                part.unlink(missing_ok=True)
            elif not self._lost(part, cuts):
                self._unfinished[_hash(part)] = part.name
        for part in sorted(self._simulation.folder.iterdir()):
            if part.is_dir():  # of a process that was killed
                for file in part.iterdir():
                    file.unlink()
                part.rmdir()
            elif ".recovered" in part.name:
                part.unlink()

    def _lost(self, part: Path, cuts: int) -> bool:
        """Return whether the power was cut since there were so many cuts, and a part was lost."""
        return self.disk.cuts != cuts and not part.exists()

    def _recover(self, part: Path, cuts: int) -> Truth | None:
        """Recover an unfinished log, on a disk with faults at first; return whose it is."""
        simulation = self._simulation
        if self._lost(part, cuts) or _hash(part) in self._unfinished:
            return None
        before, rescues = part.read_bytes(), list[Recovery]()
        process = simulation.spawn(f"recover{self._rounds}", lambda: rescues.append(recover(part)))
        process.mortal = True
        while process.alive:
            simulation.run(0.1)
        # As a process that has ended does: a memory map would keep its lock.
        error = process.error
        while error is not None:
            clear_frames(error.__traceback__)
            error = error.__cause__ or error.__context__
        if self._lost(part, cuts):
            return None
        if not rescues:
            try:
                rescues.append(recover(part))
            except LogError as error:
                if "nothing to rescue" not in str(error):
                    raise
                simulation.count("parts without content")
                return None
        if part.read_bytes() != before and self.disk.cuts == cuts:
            simulation.violate("recovery", f"{part.name} was changed by its recovery")
        rescue = rescues[0]
        if not rescue.path.exists():
            return None  # the power was cut after it
        summary(part, rescue)
        simulation.count("logs recovered")
        return self._compare(rescue.path, rescue, self.disk.cuts != cuts)

    def _compare(self, path: Path, rescue: Recovery, cut: bool) -> Truth | None:
        simulation, truth = self._simulation, self._truth_of(path)
        if truth is None:
            if not cut and rescue.n_messages:
                simulation.violate("recovery", f"{path.name} is of no run")
            return None
        if not cut and rescue.n_damaged:
            simulation.violate(
                "recovery", f"{path.name}: {rescue.n_damaged} damaged places without a power cut"
            )
        _, messages, _ = read_raw(path, lambda _: True)
        if wrong := truth.difference(messages, False, bool(rescue.n_damaged), not cut):
            simulation.violate("recovery", f"{path.name} of run {truth.number}: {wrong}")
        if not rescue.n_damaged and truth.samples and truth.kept_ns >= 0:
            self._repeat(path, truth, rescue.is_truncated)
        return truth

    def _check(self, path: Path) -> Truth | None:
        """Check a log under its final name."""
        key = path.name, _hash(path)
        try:
            truth = self._truth_of(path)
            if truth is None or key in self._checked:
                return truth
            self._checked.add(key)
            _, messages, recovered = read_raw(path, lambda _: True)
        except LogError as error:
            self._simulation.violate("recovery", f"{path.name} is taken for whole: {error}")
        if recovered:
            return truth
        if not truth.closing:
            self._simulation.violate("recovery", f"{path.name} is of run {truth.number}, which did not end")
        self._simulation.count("logs finished")
        if wrong := truth.difference(messages, True, False, True):
            self._simulation.violate("recovery", f"{path.name} of run {truth.number}: {wrong}")
        read_in_every_way(self._simulation, path, bool(truth.samples))
        damage(self._simulation, path, truth.number, has_world=bool(truth.samples))
        if truth.samples:
            self._repeat(path, truth, False)
        return truth

    def _repeat(self, path: Path, truth: Truth, torn: bool) -> None:
        """Repeat a run and compare it."""
        simulation = self._simulation
        if simulation.rng("repeat", truth.number).random() < 0.4:
            return
        try:
            difference = repeat(read_recorded_run(path))
        except KhepTwinError as error:
            if torn or "has no states" in str(error):
                return
            simulation.violate("repeat", f"{path.name} of run {truth.number}: {error}")
        if difference is not None:
            simulation.violate("repeat", f"{path.name} of run {truth.number}: {difference}")
        simulation.count("runs repeated")
        simulation.count("seconds repeated", truth.last_ns // NS_PER_S)


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


SCENARIOS = {"record": record}
