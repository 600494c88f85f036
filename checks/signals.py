"""Ends of commands by signals at random moments: exit status and remains.

    python -m checks signals 1000 --jobs 2

Each command is started and sent SIGINT, SIGTERM or SIGHUP: in one half of the cases within LATEST of its
start, in the other within LATEST of its first output. It has to end within LONGEST, normally or by the
signal, with the corresponding exit status and without a traceback. A log has to be complete, and no
unfinished file, link, note of a server, temporary file or process may be left. Otherwise the exit status
is 1.
"""

import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader

from tools.command_table import command_line

LONGEST = 4.0
"""Longest time from the signal to the end [s]."""

LATEST = 2.5
"""Longest time from the start, or from the first output, to the signal [s]."""

TIMEOUT_S = 600.0
"""Timeout of the first output on a busy machine [s]."""

HANGS = """import time

def controller(robot):
    robot.set_speed(5, 5)
    while True:
        try:
            time.sleep(1000)
        except BaseException:
            pass
"""

STUDY = """version = 1
name = "study"
playpens = ["default"]
controllers = ["braitenberg"]
seeds = 4000
seconds = 20
step_ms = 10
rollouts_per_task = 20
output = "out"
"""


@dataclass(frozen=True, slots=True)
class Kind:
    """A command to be ended.

    Attributes:
        words: Words of the command line.
        life: File that exists once it has started; empty for the first line of its output.
        good: Valid exit status after a signal, besides that of the signal.
    """

    words: Sequence[str]
    life: str = ""
    good: int | None = None


KINDS = {
    "run": Kind(
        ["run", "--playpen", "obstacles", "--seconds", "1e6", "--log", "run.mcap"], life="run.mcap.part"
    ),
    "run that hangs": Kind(["run", "hangs.py", "--log", "run.mcap"], life="run.mcap.part"),
    "series": Kind(
        ["run", "--cycles", "100", "--runs", "9999", "--save", "series", "--log", "run.mcap"],
        life="series/runs.csv",
    ),
    "serve": Kind(["serve", "--log", "run.mcap", "--link", "./robot"], good=0),
    "serve a Khepera IV": Kind(["serve", "arena4", "--log", "run.mcap", "--link", "./robot"], good=0),
    "design": Kind(["design", "--no-browser"], good=0),
    "sweep": Kind(["sweep", "study.toml", "--workers", "1"], life="out/study.json"),
    "sense": Kind(
        ["sense", "khep://default?log=run.mcap", "--linear", "10", "--runs", "100", "-o", "test.csv"],
        life="run.mcap.part",
    ),
}


@dataclass(frozen=True, slots=True)
class End:
    """End of a command.

    Attributes:
        took: Time from the signal to the end [s].
        faults: Faults found.
        early: True if it ended during the start of the interpreter, by Python's traceback.
    """

    took: float
    faults: Sequence[str]
    early: bool = False


def end_command(name: str, seed: int, *, has_started: bool | None = None) -> End:
    """Start a command, send it a signal and check the remains.

    Args:
        name: Name of the kind.
        seed: Seed of signal and moment.
        has_started: True if the signal waits for the first output; None for a random choice.
    """
    rng = random.Random(seed)
    number = rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    has_started = rng.random() < 0.5 if has_started is None else has_started
    after = rng.uniform(0, LATEST)
    kind = KINDS[name]
    with tempfile.TemporaryDirectory(prefix="khep-twin-signals-") as top:
        folder, private = Path(top) / "work", Path(top) / "private"
        folder.mkdir()
        private.mkdir(mode=0o700)
        (folder / "hangs.py").write_text(HANGS)
        (folder / "study.toml").write_text(STUDY)
        initial_names = {path.name for path in folder.iterdir()}
        environment = os.environ | {"XDG_RUNTIME_DIR": str(private), "TMPDIR": str(private)}
        with subprocess.Popen(
            [sys.executable, "-m", "khep_twin", *kind.words],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            preexec_fn=_hear,
        ) as process:
            try:
                if has_started:
                    _await(process, folder, kind.life)
                time.sleep(after)
                process.send_signal(number)
                sent = time.monotonic()
                _, errors = process.communicate(timeout=TIMEOUT_S)
                took = time.monotonic() - sent
            finally:
                process.kill()
        error_text = errors.decode("utf-8", "replace")
        # A failure while the interpreter starts is not the program's fault.
        early = (
            "Traceback" in error_text and "khep_twin/__main__" not in error_text and "cli" not in error_text
        )
        faults: list[str] = []
        if took > LONGEST:
            faults.append(f"took {took:.2f} s")
        if not early and process.returncode not in (128 + number, -number, kind.good):
            faults.append(f"status {process.returncode} of signal {number}: {error_text}")
        if not early and any(word in error_text for word in ("Traceback", "Exception", "Error")):
            faults.append(error_text)
        faults += _find_remains(folder, private, initial_names) + _check_logs(folder)
        faults += [f"process {line}" for line in _find_processes(process.pid)]
        if has_started and kind.life == "run.mcap.part" and not (folder / "run.mcap").exists():
            faults.append("no log")
    return End(took, faults, early)


def _hear() -> None:
    """Restore the signals that the parent process may have disabled."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _await(process: "subprocess.Popen[bytes]", folder: Path, life: str) -> None:
    """Wait for the first output."""
    deadline_s = time.monotonic() + TIMEOUT_S
    if not life:
        assert process.stdout is not None
        process.stdout.read(1)
    while life and not (folder / life).exists():
        assert time.monotonic() < deadline_s, "it has not started"
        assert process.poll() is None, "it has ended"
        time.sleep(0.01)


def _find_remains(folder: Path, private: Path, initial_names: set[str]) -> list[str]:
    """Return the names of forbidden remains."""
    paths = [path for path in folder.rglob("*") if path.name not in initial_names]
    left = [path for path in paths if path.name.startswith(".") or ".part" in path.name or path.is_symlink()]
    left += [path for path in private.rglob("*") if path != private / "khep_twin"]
    return [f"left {path.name}" for path in left]


def _check_logs(folder: Path) -> list[str]:
    """Return the faults of logs, by mcap's reader."""
    faults: list[str] = []
    for path in folder.glob("*.mcap"):
        with path.open("rb") as file:
            try:
                reader = make_reader(file, validate_crcs=True)
                count = sum(1 for _ in reader.iter_messages())
                summary = reader.get_summary()
                if summary is None or summary.statistics is None:
                    faults.append(f"{path.name}: has no summary")
                elif summary.statistics.message_count != count:
                    faults.append(
                        f"{path.name}: {count} messages, {summary.statistics.message_count} in its summary"
                    )
            except Exception as error:  # any fault of the log
                faults.append(f"{path.name}: {error!r}")
    return faults


def _find_processes(session: int) -> list[str]:
    """Return the names of the remaining processes of a session."""
    commands: list[str] = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, its_session = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(its_session) == session and state != "Z":
                commands.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except (OSError, ValueError):
            continue
    return commands


def main() -> int:
    """Run the requested number of cases and print the results."""
    parser = command_line(__doc__)
    parser.add_argument("count", type=int, nargs="?", default=1000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=[*KINDS])
    wish = parser.parse_args()
    names = [wish.only] if wish.only else [*KINDS]
    cases = [(names[i % len(names)], wish.seed + i) for i in range(wish.count)]

    def one(case: tuple[str, int]) -> End:
        ended = end_command(*case)
        for fault in ended.faults:
            print(f"{case[0]}, seed {case[1]}: {fault}", flush=True)
        return ended

    with ThreadPoolExecutor(wish.jobs) as pool:
        ends = list(pool.map(one, cases))
    for name in dict.fromkeys(name for name, _ in cases):
        took = [record.took for record, case in zip(ends, cases, strict=True) if case[0] == name]
        print(
            f"{name}: {len(took)} signals, ended after [s]: median {statistics.median(took):.2f}  "
            f"max {max(took):.2f}"
        )
    faulty, early = sum(bool(record.faults) for record in ends), sum(record.early for record in ends)
    print(f"{len(ends)} signals, {faulty} with faults, {early} during the start of the interpreter")
    return 1 if faulty else 0
