"""A participant's file scored in its own process, with limits of its time, its memory and its output.

    python -m khep_twin.lab.challenge.attempt JSON    # the process itself; JSON has its settings

Whatever the file does, an `Attempt` has its score, or one line that says why there is none. The process keeps
no one from reading files or using the network: it protects a table from mistakes, not a machine from malice.
Its parent is a `keeper`, so that a file that kills its parent does not end the table.
"""

import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from khep_twin.errors import KhepTwinError, StoppedError
from khep_twin.files.atomic import write_whole
from khep_twin.files.paths import StrPath
from khep_twin.lab.challenge.challenge import ChallengeFile, load
from khep_twin.lab.challenge.scoring import Score, is_worth_compiling, score
from khep_twin.shutdown import EXIT_S, INTERRUPTION_S
from khep_twin.signals import answered
from khep_twin.simulation.ready import when_ready

REAL_SECONDS = 60.0
"""Longest real time of a file [s]; the longest reference solution takes a tenth (measured)."""

MEMORY_GIB = 2
"""Most memory of a file's process, besides shared libraries; reference solutions take a fifth (measured)."""

PRINTED_MB = 2
"""Most text that a file may print."""

_KEPT = 4096
"""Length of printed text that is kept [bytes]."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """Result of a file in a challenge.

    Attributes:
        file: Controller file.
        score: Its score; None without.
        reason: One line that says why there is no score; empty with a score.
        lines: Number of lines that it printed.
        last_line: Last of these lines, shortened.
    """

    file: str
    score: Score | None
    reason: str = ""
    lines: int = 0
    last_line: str = ""

    @property
    def note(self) -> str:
        """Reason why there is no score, or what the file printed."""
        if self.reason or not self.lines:
            return self.reason
        many = f"printed {self.lines} line{'s' if self.lines > 1 else ''}"
        return f"{many}, the last: {self.last_line}" if self.last_line else many


def score_file(
    file: ChallengeFile,
    controller: str,
    *,
    runs: int | None = None,
    seed: int | None = None,
    log: StrPath | None = None,
    real_seconds: float = REAL_SECONDS,
    show: Callable[[bytes], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Attempt:
    """Score a controller file in its own process.

    Args:
        file: Challenge.
        controller: Controller, FILE.py, FILE.py:NAME or a network's FILE.npz.
        runs: Number of runs; the challenge's by default.
        seed: Seed of the first run; the challenge's by default.
        log: Log to record.
        real_seconds: Real time after which the process is ended [s].
        show: Called with what the file prints, as it comes.
        stop: Asked ten times a second; when it returns True, the process is ended.

    Raises:
        StoppedError: `stop` has returned True.
    """
    settings = {
        "challenge": file.name,
        "controller": controller,
        "runs": file.challenge.runs if runs is None else runs,
        "seed": file.challenge.seed if seed is None else seed,
        "log": None if log is None else str(log),
        "real_seconds": real_seconds,
    }
    if sys.platform == "win32":
        raise KhepTwinError("challenges need a system of Unix, which ends a process with all that it started")
    printed = _Printed(show)
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        result = Path(folder) / "result.json"
        words = [sys.executable, "-P", str(Path(__file__).with_name("keeper.py")), str(MEMORY_GIB << 30)]
        words += [sys.executable, "-P", "-m", __name__, json.dumps({**settings, "result": str(result)})]
        process = subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1"},
        )
        try:
            ended = _follow(process, printed, time.monotonic() + real_seconds, stop or (lambda: False))
        finally:
            _end(process)
        told = _read(result)
    if (given := _score(told)) is not None:
        reason = ""
    elif printed.size > PRINTED_MB * 10**6:
        reason = f"{controller}: printed {printed.lines} lines; expected at most {PRINTED_MB} MB of text"
    elif "reason" in told:
        path = controller.partition(":")[0]
        reason = str(told["reason"]).replace(os.path.abspath(path), path)
        if "MemoryError" in reason:
            reason = f"{reason.rstrip(': ')}; expected at most {MEMORY_GIB} GiB"
    elif not ended:
        wanted = "cycles that end, and loops that ask the robot something or call robot.sleep"
        reason = f"{controller}: not finished after {real_seconds:g} s of real time; expected {wanted}"
    else:
        reason = f"{controller}: {_ending(process.returncode)}; expected a controller that returns"
    return Attempt(controller, given, reason, printed.lines, printed.last_line)


class _Printed:
    """Text printed by a process, of which little is kept.

    Attributes:
        lines: Number of lines.
        size: Length [bytes].
    """

    def __init__(self, show: Callable[[bytes], None] | None) -> None:
        self._show, self._tail, self.lines, self.size = show, b"", 0, 0

    def add(self, data: bytes) -> None:
        """Add a piece of it."""
        if self._show is not None:
            self._show(data)
        self.lines += data.count(b"\n")
        self.size += len(data)
        self._tail = (self._tail + data)[-_KEPT:]

    @property
    def last_line(self) -> str:
        """Last line that is not empty, at most 80 characters of it."""
        lines = [line for line in self._tail.decode("utf-8", "replace").splitlines() if line.strip()]
        shown = "".join(char if char.isprintable() else " " for char in (lines or [""])[-1]).strip()
        return shown if len(shown) <= 80 else f"{shown[:77]}..."


def _follow(
    process: "subprocess.Popen[bytes]", printed: _Printed, deadline: float, stop: Callable[[], bool]
) -> bool:
    """Read what a process prints until it has ended; return False if it takes longer, or prints too much.

    Raises:
        StoppedError: `stop` has returned True.
    """
    assert process.stdout is not None
    output = process.stdout.fileno()
    is_open = True
    while (left := deadline - time.monotonic()) > 0 and printed.size <= PRINTED_MB * 10**6:
        if stop():
            raise StoppedError("the attempt was stopped")
        ended = _has_ended(process)
        if is_open and select.select([output], [], [], 0 if ended else min(left, 0.1))[0]:
            data = os.read(output, 65536)
            is_open = bool(data)
            printed.add(data)
        elif ended:
            return True
        elif not is_open:
            time.sleep(min(left, 0.02))
    return False


def _has_ended(process: "subprocess.Popen[bytes]") -> bool:
    """Return whether a process has ended; on Linux it keeps its number until it is waited for."""
    if sys.platform == "linux":
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
    return process.poll() is not None


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End a process and all that it started in its group: by SIGTERM, which completes a log, then by SIGKILL.

    Until it is waited for, no other group can have its number.
    """
    for _ in range(2):  # the keeper passes on the first one, and kills the file's process by the second
        if _has_ended(process):
            break
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGTERM)
        deadline = time.monotonic() + INTERRUPTION_S + 2 * EXIT_S
        while time.monotonic() < deadline and not _has_ended(process):
            time.sleep(0.02)
    with suppress(ProcessLookupError, PermissionError):
        if sys.platform != "win32":
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


def _read(result: Path) -> dict[str, Any]:
    """Return what the process has written, empty if it is not there or damaged."""
    try:
        found = json.loads(result.read_bytes())
    except (OSError, ValueError):
        found = None
    return found if isinstance(found, dict) else {}  # pyright: ignore[reportUnknownVariableType]


def _score(told: dict[str, Any]) -> Score | None:
    """Return the score that the process has written; None without."""
    try:
        found = told["score"]
        return Score(float(found["value"]), tuple(map(float, found["runs"])), dict(found["metrics"]))
    except (LookupError, TypeError, ValueError):
        return None


def _ending(code: int) -> str:
    """Return how a process without a result has ended."""
    if code < 0:
        named = {each.value: each.name for each in signal.Signals}
        return f"its process was ended by {named.get(-code, f'signal {-code}')}"
    return f"ended its process, with exit code {code}"


def _main(settings: dict[str, Any]) -> None:
    """Write the score of a file, or the reason why there is none, to the file `result`."""
    log = None if settings["log"] is None else Path(settings["log"])
    result = Path(settings["result"])
    # Should the process be orphaned, this ends it.
    if sys.platform != "win32":
        signal.alarm(math.ceil(settings["real_seconds"] + INTERRUPTION_S + 2 * EXIT_S))
    try:
        with answered():
            challenge = load(settings["challenge"])
            if is_worth_compiling(challenge.challenge, settings["runs"]):
                with redirect_stderr(StringIO()):  # that numba compiles is nothing that the file prints
                    when_ready("world")
                    when_ready("vision")
            found = score(challenge, settings["controller"], settings["runs"], settings["seed"], log)
            told: dict[str, Any] = {"score": asdict(found)}
    except KhepTwinError as error:
        told = {"reason": "; ".join(str(error).splitlines())}
    write_whole(result, json.dumps(told).encode("utf-8"))


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
