"""Table of a class's results in a challenge: all controller files of a folder, the best first."""

import csv
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from io import StringIO
from pathlib import Path

from khep_twin.errors import ChallengeError
from khep_twin.files.text import escape_surrogates
from khep_twin.lab.challenge.attempt import REAL_SECONDS, Attempt, score_file
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile


def participants(folder: Path) -> list[Path]:
    """Return the Python files of a folder in order of their names, except names that start with "_" or ".".

    Raises:
        ChallengeError: There is no such folder, or no such file in it.
    """
    if not folder.is_dir():
        raise ChallengeError("no such folder", file=folder, expected="a folder of controller files")
    files = sorted(path for path in folder.glob("*.py") if path.name[0] not in "_.")
    if not files:
        raise ChallengeError("has no controller file", file=folder, expected="files that end in .py")
    return files


def score_files(
    file: ChallengeFile,
    files: Sequence[Path],
    *,
    runs: int | None = None,
    seed: int | None = None,
    real_seconds: float = REAL_SECONDS,
    jobs: int = 1,
    on_result: Callable[[Attempt, float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Attempt]:
    """Score files, each in a separate process, with the options of `attempt.score_file`.

    Args:
        file: Challenge.
        files: Controller files.
        runs: Number of runs; the challenge's by default.
        seed: Seed of the first run; the challenge's by default.
        real_seconds: Real time after which a process is terminated [s].
        jobs: Number of parallel processes; it does not affect the results.
        on_result: Called with each result when it is available, and the completed share.
        stop: Called ten times a second; when it returns True, all processes are terminated.

    Raises:
        StoppedError: `stop` returned True.
    """
    stop_event = threading.Event()

    def is_over() -> bool:
        return stop_event.is_set() or (stop is not None and stop())

    def score_one(path: Path) -> Attempt:
        try:
            return score_file(file, str(path), runs=runs, seed=seed, real_seconds=real_seconds, stop=is_over)
        except OSError as error:  # no process can be started, as the limit of processes is reached
            return Attempt(str(path), None, f"{path}: cannot be run: {error.strerror}")

    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(score_one, path) for path in files]
        try:
            for number, future in enumerate(as_completed(futures), 1):
                if on_result is not None:
                    on_result(future.result(), number / len(files))
            return [future.result() for future in futures]
        finally:
            stop_event.set()
            pool.shutdown(wait=False, cancel_futures=True)


def rank_attempts(challenge: Challenge, attempts: Iterable[Attempt]) -> list[tuple[int | None, Attempt]]:
    """Return attempts with their ranks, the best first; equal scores share a rank."""
    sign = -1 if challenge.better == "higher" else 1
    scored = [(sign * entry.score.value, entry.file, entry) for entry in attempts if entry.score is not None]
    unscored = sorted((entry for entry in attempts if entry.score is None), key=lambda attempt: attempt.file)
    rows = [
        (1 + sum(other_value < value for other_value, _, _ in scored), attempt)
        for value, _, attempt in sorted(scored, key=lambda row: row[:2])
    ]
    return [*rows, *((None, attempt) for attempt in unscored)]


def table(challenge: Challenge, attempts: Sequence[Attempt]) -> str:
    """Return attempts as lines of text."""
    name_width = max(11, *(len(_name(attempt)) for attempt in attempts))
    header = f"{'rank':>4}  {'participant':{name_width}}  {'score':>8}  {'passed':6}  note".rstrip()
    lines = [header]
    for rank, entry in rank_attempts(challenge, attempts):
        value = "" if entry.score is None else f"{entry.score.value:.4g}"
        verdict, note = _passed_text(challenge, entry), escape_surrogates(entry.note)
        row = f"{rank or '-':>4}  {_name(entry):{name_width}}  {value:>8}  {verdict:6}  {note}"
        lines.append(row.rstrip())
    return "\n".join(lines)


def to_csv(challenge: Challenge, attempts: Sequence[Attempt]) -> bytes:
    """Return attempts as a CSV file, with all digits of the scores and of each run's score."""
    n_runs = max((len(attempt.score.runs) for attempt in attempts if attempt.score is not None), default=0)
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["rank", "participant", "score", "passed", "note", *(f"run_{n + 1}" for n in range(n_runs))]
    )
    for rank, attempt in rank_attempts(challenge, attempts):
        score = attempt.score
        value, *of_runs = [""] * (1 + n_runs) if score is None else [score.value, *score.runs]
        note = _plain_note(escape_surrogates(attempt.note))
        writer.writerow([rank or "", _name(attempt), value, _passed_text(challenge, attempt), note, *of_runs])
    return text.getvalue().encode("utf-8")


def _name(attempt: Attempt) -> str:
    return escape_surrogates(Path(attempt.file).stem)


def _passed_text(challenge: Challenge, attempt: Attempt) -> str:
    passes = None if attempt.score is None else challenge.passes(attempt.score.value)
    return "" if passes is None else "yes" if passes else "no"


def _plain_note(note: str) -> str:
    """Return a text that a spreadsheet does not interpret as a formula."""
    return f"'{note}" if note[:1] in ("=", "+", "-", "@") else note
