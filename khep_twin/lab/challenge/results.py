"""Table of a class's results in a challenge: every controller file of a folder, the best first."""

import csv
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from io import StringIO
from pathlib import Path

from khep_twin.errors import ChallengeError
from khep_twin.files.text import encodable
from khep_twin.lab.challenge.attempt import REAL_SECONDS, Attempt, score_file
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile


def participants(folder: Path) -> list[Path]:
    """Return the Python files of a folder by their names, without those that begin with "_" or ".".

    Raises:
        ChallengeError: There is no such folder, or none in it.
    """
    if not folder.is_dir():
        raise ChallengeError("no such folder", file=folder, expected="a folder of controller files")
    found = sorted(path for path in folder.glob("*.py") if path.name[0] not in "_.")
    if not found:
        raise ChallengeError("has no controller file", file=folder, expected="files that end in .py")
    return found


def attempts(
    file: ChallengeFile,
    files: Sequence[Path],
    *,
    runs: int | None = None,
    seed: int | None = None,
    real_seconds: float = REAL_SECONDS,
    jobs: int = 1,
    done: Callable[[Attempt, float], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> list[Attempt]:
    """Score files, each in its own process, with the options of `attempt`.

    Args:
        file: Challenge.
        files: Controller files.
        runs: Number of runs; the challenge's by default.
        seed: Seed of the first run; the challenge's by default.
        real_seconds: Real time after which a process is ended [s].
        jobs: Number of processes side by side; the results are the same.
        done: Called with each result as it comes, and the part that is done.
        stop: Asked ten times a second; when it returns True, all processes are ended.

    Raises:
        StoppedError: `stop` has returned True.
    """
    ended = threading.Event()

    def is_over() -> bool:
        return ended.is_set() or (stop is not None and stop())

    def one(path: Path) -> Attempt:
        try:
            return score_file(file, str(path), runs=runs, seed=seed, real_seconds=real_seconds, stop=is_over)
        except OSError as error:  # no process can be started now, as others have taken all there may be
            return Attempt(str(path), None, f"{path}: cannot be run: {error.strerror}")

    with ThreadPoolExecutor(jobs) as pool:
        waiting = [pool.submit(one, path) for path in files]
        try:
            for number, each in enumerate(as_completed(waiting), 1):
                if done is not None:
                    done(each.result(), number / len(files))
            return [each.result() for each in waiting]
        finally:
            ended.set()
            pool.shutdown(wait=False, cancel_futures=True)


def ranked(challenge: Challenge, found: Iterable[Attempt]) -> list[tuple[int | None, Attempt]]:
    """Return attempts with their ranks, the best first; equal scores share a rank."""
    sign = -1 if challenge.better == "higher" else 1
    scored = [(sign * each.score.value, each.file, each) for each in found if each.score is not None]
    rest = sorted((each for each in found if each.score is None), key=lambda each: each.file)
    rows = [
        (1 + sum(other < value for other, _, _ in scored), each)
        for value, _, each in sorted(scored, key=lambda row: row[:2])
    ]
    return [*rows, *((None, each) for each in rest)]


def table(challenge: Challenge, found: Sequence[Attempt]) -> str:
    """Return attempts as lines of text."""
    width = max(11, *(len(_name(each)) for each in found))
    head = f"{'rank':>4}  {'participant':{width}}  {'score':>8}  {'passed':6}  note".rstrip()
    lines = [head]
    for rank, each in ranked(challenge, found):
        value = "" if each.score is None else f"{each.score.value:.4g}"
        passed = _passed(challenge, each)
        row = f"{rank or '-':>4}  {_name(each):{width}}  {value:>8}  {passed:6}  {encodable(each.note)}"
        lines.append(row.rstrip())
    return "\n".join(lines)


def to_csv(challenge: Challenge, found: Sequence[Attempt]) -> bytes:
    """Return attempts as a CSV file, with all digits of the scores and those of each run."""
    runs = max((len(each.score.runs) for each in found if each.score is not None), default=0)
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["rank", "participant", "score", "passed", "note", *(f"run_{n + 1}" for n in range(runs))]
    )
    for rank, each in ranked(challenge, found):
        score = each.score
        value, *of_runs = [""] * (1 + runs) if score is None else [score.value, *score.runs]
        note = _plain(encodable(each.note))
        writer.writerow([rank or "", _name(each), value, _passed(challenge, each), note, *of_runs])
    return text.getvalue().encode("utf-8")


def _name(attempt: Attempt) -> str:
    return encodable(Path(attempt.file).stem)


def _passed(challenge: Challenge, attempt: Attempt) -> str:
    passes = None if attempt.score is None else challenge.passes(attempt.score.value)
    return "" if passes is None else "yes" if passes else "no"


def _plain(note: str) -> str:
    """Return a text that a spreadsheet does not take for a formula."""
    return f"'{note}" if note[:1] in ("=", "+", "-", "@") else note
