"""The long checks of a night, in parts that accumulate over calls, and one page with their figures.

    python -m checks night run                       all that is missing, on all cores; `make long`
    python -m checks night run fuzz-board day        some parts; `make long LONG="fuzz-board day"`
    python -m checks night run --share 0.01          a share of each part; `make long LONG_SHARE=0.01`
    python -m checks night list                      all parts, with their progress
    python -m checks night page                      write the page out/night/page.md again

Each part runs in processes of one share each. A finished share is kept in out/night, so that an interruption
loses at most those under way. Counts come from the output of the processes. A finding ends its part: its
output and the command that reproduces it are kept, the other parts continue, and the exit status is 1. The
next call tries that share again.
"""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from math import ceil
from pathlib import Path
from typing import Any

from checks.night.page import markdown, number
from checks.night.parts import CORES, PARTS, Part, Share
from tools.command_table import command_line

OUT = Path("out/night")

LINES = 40
"""Lines of a finding's output that are kept."""


@dataclass
class Run:
    """Run of one share.

    Attributes:
        number: Number of the share.
        wanted: Requested count.
        count: Count in its output.
        seconds: Wall time [s].
        status: Exit status; None if it was interrupted.
        command: Command line, which repeats the run.
        date: Date and time of its end, UTC.
        commit: Commit of the checkout, with + if it was changed.
        figures: Lines of its output.
        finding: Last lines of the output of a run that failed; empty for none.
    """

    number: int
    wanted: float
    count: float
    seconds: float
    status: int | None
    command: str
    date: str
    commit: str
    figures: list[str] = field(default_factory=list)
    finding: str = ""


class State:
    """Runs of a part, kept in a file."""

    def __init__(self, part: Part, folder: Path) -> None:
        self.part, self.path = part, folder / f"{part.name}.json"
        records = json.loads(self.path.read_text()) if self.path.exists() else []
        self.runs = [Run(**record) for record in records]

    @property
    def completed_count(self) -> float:
        """Count of the runs without a finding."""
        return sum(run.count for run in self.runs if not run.finding)

    @property
    def number(self) -> int:
        """Number of the next share."""
        return max((run.number + (not run.finding) for run in self.runs), default=0)

    @property
    def findings(self) -> list[Run]:
        """Findings that no later run of their share has undone."""
        good = {run.number for run in self.runs if not run.finding}
        return [run for run in self.runs if run.finding and run.number not in good]

    def add(self, run: Run) -> None:
        """Keep a run; one of a share that was a finding replaces it."""
        self.runs = [stored for stored in self.runs if not (stored.finding and stored.number == run.number)]
        self.runs.append(run)
        text = json.dumps([asdict(stored) for stored in self.runs], indent=1)
        new = self.path.with_suffix(".new")
        new.write_text(text)
        new.replace(self.path)


class Process:
    """Process of a share, with its output in a file."""

    def __init__(self, part: Part, share: Share, folder: Path) -> None:
        self.part, self.share = part, share
        self.log = folder / f"{part.name}-{share.number}.txt"
        self._command, self._variables = part.command(share), part.environment(share)
        self._start_s = time.monotonic()
        paths = [str(Path.cwd()), *filter(None, [os.environ.get("PYTHONPATH", "")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **self._variables}
        with self.log.open("wb") as file:
            self._process = subprocess.Popen(
                [*self._command, *artifacts(part, folder)],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

    def ended(self) -> bool:
        """Return whether it has ended."""
        return self._process.poll() is not None

    def stop(self) -> None:
        """End it with all that it has started."""
        for signal_number in (signal.SIGINT, signal.SIGKILL):
            try:
                os.killpg(self._process.pid, signal_number)
                self._process.wait(10)
            except (ProcessLookupError, subprocess.TimeoutExpired):
                continue
        self._process.wait()

    def run(self, commit: str, stopped: bool = False) -> Run:
        """Return the result, by the output; of a finding the output is kept."""
        output = self.log.read_text(errors="replace").replace("\r", "\n")
        status = None if stopped else self._process.returncode
        count = self.part.count_under_way(output) if stopped else self.part.count(output)
        finding = ""
        if status:
            finding = "\n".join(output.splitlines()[-LINES:]) or f"exit status {status}, no output"
        elif status == 0 and not count:
            finding = "\n".join([*output.splitlines()[-LINES:], "the output has no count"])
        if not finding:
            self.log.unlink()
        words = [*(f"{name}={value}" for name, value in self._variables.items()), *map(plain, self._command)]
        return Run(
            self.share.number,
            self.share.count,
            count,
            round(time.monotonic() - self._start_s, 1),
            status,
            shlex.join(words),
            datetime.now(UTC).strftime("%Y-%m-%d %H:%M"),
            commit,
            [] if stopped else self.part.shown_lines(output),
            finding,
        )


def artifacts(part: Part, folder: Path) -> list[str]:
    """Return the option by which libFuzzer keeps a finding's input in the folder."""
    is_fuzzed = part.count_pattern.startswith("^Done")
    return [f"-artifact_prefix={folder}/{part.name}-"] if is_fuzzed else []


def plain(word: str) -> str:
    """Return a word of a command for a reader: Python by its name."""
    return "python" if word == sys.executable else word


def commit_now() -> str:
    """Return the checkout's commit, with + if files were changed; "unknown" outside a checkout."""
    git = ["git", "rev-parse", "--short", "HEAD"], ["git", "status", "--porcelain", "--untracked-files=no"]
    try:
        head, changed = (
            subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip() for words in git
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + "+" * bool(changed)


def target_count(part: Part, share: float) -> float:
    """Return the count that a share of a night wants of a part."""
    if share == 1:
        return part.total
    count = part.total * share
    return max(ceil(count) if part.minimum == 1 else count, part.minimum)


class Night:
    """Runner of parts on so many cores."""

    def __init__(self, parts: Sequence[Part], share: float, folder: Path, cores: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._cores, self._part_share = folder, cores, share
        self._states = {part.name: State(part, folder) for part in parts}
        self._ended: set[str] = set()  # by a finding
        self._running: list[Process] = []
        self._commit = commit_now()

    def run(self) -> int:
        """Run all missing shares; return 1 if there is a finding."""
        try:
            while self._start() or self._running:
                self._reap()
        except KeyboardInterrupt:
            print("interrupted; finished shares are kept", flush=True)
            for process in self._running:
                process.stop()
                run = process.run(self._commit, stopped=True)
                if run.count:
                    self._states[process.part.name].add(run)
        write_page(self._folder)
        findings = [(state, run) for state in self._states.values() for run in state.findings]
        for state, run in findings:
            print(f"{state.part.name}: a finding: {run.command}")
        return 1 if findings else 0

    def _start(self) -> bool:
        """Start as many shares as fit on the cores; return whether any was started."""
        started = False
        while len(self._running) < self._cores and (task := self._next()) is not None:
            part, share = task
            print(f"{part.name}: share {share.number}, {share.count:g} {part.unit}", flush=True)
            self._running.append(Process(part, share, self._folder))
            started = True
        return started

    def _next(self) -> tuple[Part, Share] | None:
        """Return the next share that may run now; None if there is none."""
        if any(process.part.alone for process in self._running):
            return None
        for state in self._states.values():
            part = state.part
            if part.name in self._ended:
                continue
            mine = [process.share for process in self._running if process.part is part]
            first = state.completed_count + sum(share.count for share in mine)
            left = target_count(part, self._part_share) - first
            if left < 1e-6 or (part.alone and self._running):
                if left >= 1e-6:
                    return None  # the others end first
                continue
            place = max([state.number, *(share.number + 1 for share in mine)])
            return part, Share(place, first, max(min(left, part.share), part.minimum))
        return None

    def _reap(self) -> None:
        """Wait until a process has ended, and keep its result."""
        while not (ended := [process for process in self._running if process.ended()]):
            time.sleep(0.05)
        for process in ended:
            self._running.remove(process)
            name, run = process.part.name, process.run(self._commit)
            state = self._states[name]
            state.add(run)
            progress = (
                f"{run.count:g} in {run.seconds:.0f} s, {state.completed_count:g} of {process.part.total:g}"
            )
            print(f"{name}: " + ("a finding" if run.finding else progress), flush=True)
            if run.finding:
                self._ended.add(name)
            write_page(self._folder)


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of the page, one for each part."""
    table: list[dict[str, Any]] = []
    for part in PARTS:
        state = State(part, folder)
        runs = state.runs
        last = max(runs, key=lambda run: run.date, default=None)
        table.append(
            {
                "part": part,
                "done": state.completed_count,
                "seconds": sum(run.seconds for run in runs),
                "command": "" if last is None else last.command,
                "figures": [] if last is None else last.figures,
                "date": "" if last is None else last.date,
                "commits": list(dict.fromkeys(run.commit for run in runs)),
                "findings": state.findings,
            }
        )
    return table


def write_page(folder: Path) -> None:
    """Write the page."""
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    (folder / "page.md").write_text(markdown(rows(folder), now))


def main() -> int:
    """Run the command; return 1 if there is a finding."""
    parser = command_line(__doc__)
    parser.add_argument("what", choices=["run", "list", "page"])
    names = [part.name for part in PARTS]
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(names))
    parser.add_argument(
        "--share",
        type=float,
        default=1.0,
        help="share of a whole night, above 0 to 1; below 1 parts without shares are left out",
    )
    parser.add_argument("--jobs", type=int, default=CORES, help="parallel processes")
    parser.add_argument("--folder", type=Path, default=OUT)
    wish = parser.parse_intermixed_args()
    if unknown := sorted(set(wish.parts) - set(names)):
        parser.error(f"{unknown[0]}: no such part; expected some of {', '.join(names)}")
    if not 0 < wish.share <= 1 or wish.jobs < 1:
        parser.error(f"--share {wish.share:g} --jobs {wish.jobs}: expected above 0 to 1, and at least 1")
    if wish.what == "run":
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # otherwise its processes would continue
        requested = wish.parts or [part.name for part in PARTS if wish.share == 1 or part.total > part.share]
        parts = [part for part in PARTS if part.name in requested]
        return Night(parts, wish.share, wish.folder, wish.jobs).run()
    wish.folder.mkdir(parents=True, exist_ok=True)
    if wish.what == "list":
        for row in rows(wish.folder):
            part = row["part"]
            progress = f"{number(row['done']):>10} of {number(part.total):>10} {part.unit}"
            print(f"{part.name:13} {progress:41} {part.description}")
    else:
        write_page(wish.folder)
        print(wish.folder / "page.md")
    return 0
