"""Score of a participant's file from a separate process, with limits of time, memory and output.

    python -m khep_twin.lab.challenge.attempt JSON    # the process itself; JSON has its settings

An `Attempt` always has the file's score, or one line with the reason for its absence. The process may read
files and use the network: it protects a table of scores from mistakes, not a machine from malice. Its parent
is a `keeper`, so that a file that kills its parent does not end the process of the table.
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

from pydantic import TypeAdapter

from khep_twin.errors import KhepTwinError, StoppedError
from khep_twin.files.atomic import write_atomic
from khep_twin.files.paths import StrPath
from khep_twin.lab.challenge.challenge import ChallengeFile, load
from khep_twin.lab.challenge.scoring import Score, is_worth_compiling, score
from khep_twin.process.shutdown import EXIT_S, INTERRUPTION_S
from khep_twin.process.signals import handle_signals
from khep_twin.simulation.ready import when_ready

REAL_SECONDS = 60.0
"""Time-out of a file in real time [s]; the longest reference solution takes a tenth (measured)."""

MEMORY_GIB = 2
"""Memory limit of a file's process, without shared libraries; reference solutions use a fifth (measured)."""

PRINTED_MB = 2
"""Limit of the text that a file may print."""

_TAIL_BYTES = 4096
"""Length of the stored end of the printed text [bytes]."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """Result of a file in a challenge.

    Attributes:
        file: Controller file.
        score: Its score; None without.
        reason: Reason why there is no score, in one line; empty with a score.
        lines: Number of printed lines.
        last_line: Last printed line, shortened.
    """

    file: str
    score: Score | None
    reason: str = ""
    lines: int = 0
    last_line: str = ""

    @property
    def note(self) -> str:
        """Reason why there is no score, or a summary of the printed text."""
        if self.reason or not self.lines:
            return self.reason
        summary = f"printed {self.lines} line{'s' if self.lines > 1 else ''}"
        return f"{summary}, the last: {self.last_line}" if self.last_line else summary


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
    """Score a controller file in a separate process.

    Args:
        file: Challenge.
        controller: Controller, FILE.py, FILE.py:NAME or a network's FILE.npz.
        runs: Number of runs; the challenge's by default.
        seed: Seed of the first run; the challenge's by default.
        log: Log to record.
        real_seconds: Real time after which the process is terminated [s].
        show: Called with each piece of printed text when it arrives.
        stop: Called ten times a second; when it returns True, the process is terminated.

    Raises:
        StoppedError: `stop` returned True.
    """
    settings: dict[str, object] = {
        "challenge": file.name,
        "controller": controller,
        "runs": file.challenge.runs if runs is None else runs,
        "seed": file.challenge.seed if seed is None else seed,
        "log": None if log is None else str(log),
        "real_seconds": real_seconds,
    }
    if sys.platform == "win32":
        raise KhepTwinError("challenges need a system of Unix, which ends a process with all that it started")
    output = _PrintedText(show)
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        result_path = Path(folder) / "result.json"
        arguments = [sys.executable, "-P", str(Path(__file__).with_name("keeper.py")), str(MEMORY_GIB << 30)]
        settings["result"] = str(result_path)
        arguments += [sys.executable, "-P", "-m", __name__, json.dumps(settings)]
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, "PYTHONHASHSEED": "0", "PYTHONUNBUFFERED": "1"},
        )
        try:
            deadline = time.monotonic() + real_seconds
            is_finished = _read_output(process, output, deadline, stop or (lambda: False))
        finally:
            _terminate(process)
        result = _read_result(result_path)
    if result.score is not None:
        reason = ""
    elif output.size > PRINTED_MB * 10**6:
        reason = f"{controller}: printed {output.lines} lines; expected at most {PRINTED_MB} MB of text"
    elif result.reason:
        path = controller.partition(":")[0]
        reason = result.reason.replace(os.path.abspath(path), path)
        if "MemoryError" in reason:
            reason = f"{reason.rstrip(': ')}; expected at most {MEMORY_GIB} GiB"
    elif not is_finished:
        expected = "cycles that end, and loops that ask the robot something or call robot.sleep"
        reason = f"{controller}: not finished after {real_seconds:g} s of real time; expected {expected}"
    else:
        reason = f"{controller}: {_describe_exit(process.returncode)}; expected a controller that returns"
    return Attempt(controller, result.score, reason, output.lines, output.last_line)


@dataclass(frozen=True, slots=True)
class _Result:
    """Result that the process writes: a score, or the reason why there is none."""

    score: Score | None = None
    reason: str = ""


class _PrintedText:
    """Text printed by a process; only its end is stored.

    Attributes:
        lines: Number of lines.
        size: Length [bytes].
    """

    def __init__(self, show: Callable[[bytes], None] | None) -> None:
        self._show = show
        self._tail = b""
        self.lines = self.size = 0

    def add(self, data: bytes) -> None:
        """Add a piece of text."""
        if self._show is not None:
            self._show(data)
        self.lines += data.count(b"\n")
        self.size += len(data)
        self._tail = (self._tail + data)[-_TAIL_BYTES:]

    @property
    def last_line(self) -> str:
        """Last line that is not empty, shortened to 80 characters."""
        lines = [line for line in self._tail.decode("utf-8", "replace").splitlines() if line.strip()]
        text = "".join(char if char.isprintable() else " " for char in (lines or [""])[-1]).strip()
        return text if len(text) <= 80 else f"{text[:77]}..."


def _read_output(
    process: "subprocess.Popen[bytes]", output: _PrintedText, deadline: float, stop: Callable[[], bool]
) -> bool:
    """Read a process's output to its end; return False for a time-out, or for too much output.

    Raises:
        StoppedError: `stop` returned True.
    """
    assert process.stdout is not None
    descriptor = process.stdout.fileno()
    is_open = True
    while (remaining := deadline - time.monotonic()) > 0 and output.size <= PRINTED_MB * 10**6:
        if stop():
            raise StoppedError("the attempt was stopped")
        has_ended = _has_ended(process)
        if is_open and select.select([descriptor], [], [], 0 if has_ended else min(remaining, 0.1))[0]:
            data = os.read(descriptor, 65536)
            is_open = bool(data)
            output.add(data)
        elif has_ended:
            return True
        elif not is_open:
            time.sleep(min(remaining, 0.02))
    return False


def _has_ended(process: "subprocess.Popen[bytes]") -> bool:
    """Return whether a process has ended; on Linux its number stays reserved until `wait`."""
    if sys.platform == "linux":
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT | os.WNOHANG) is not None
    return process.poll() is not None


def _terminate(process: "subprocess.Popen[bytes]") -> None:
    """Terminate a process and its group: by SIGTERM, which completes a log, then by SIGKILL.

    Until `wait`, no other group can have its number.
    """
    for _ in range(2):  # the keeper forwards the first one, and kills the file's process at the second
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


def _read_result(result_path: Path) -> _Result:
    """Return the result that the process wrote; an empty one if it is missing or damaged."""
    try:
        return TypeAdapter(_Result).validate_json(result_path.read_bytes())
    except (OSError, ValueError):
        return _Result()


def _describe_exit(code: int) -> str:
    """Return how a process without a result ended, in words."""
    if code < 0:
        names = {number.value: number.name for number in signal.Signals}
        return f"its process was ended by {names.get(-code, f'signal {-code}')}"
    return f"ended its process, with exit code {code}"


def _main(settings: dict[str, Any]) -> None:
    """Write the score of a file, or the reason why there is none, to the file `result`."""
    log = None if settings["log"] is None else Path(settings["log"])
    result_path = Path(settings["result"])
    # The alarm ends an orphaned process.
    if sys.platform != "win32":
        signal.alarm(math.ceil(settings["real_seconds"] + INTERRUPTION_S + 2 * EXIT_S))
    try:
        with handle_signals():
            challenge = load(settings["challenge"])
            if is_worth_compiling(challenge.challenge, settings["runs"]):
                with redirect_stderr(StringIO()):  # numba's notes are not output of the file
                    when_ready("world")
                    when_ready("vision")
            arguments = settings["controller"], settings["runs"], settings["seed"], log
            result = _Result(score(challenge, *arguments))
    except KhepTwinError as error:
        result = _Result(reason="; ".join(str(error).splitlines()))
    write_atomic(result_path, json.dumps(asdict(result)).encode("utf-8"))


if __name__ == "__main__":
    _main(json.loads(sys.argv[1]))
