"""Challenges in the page: one program, or one folder of programs, is scored at a time, in separate processes.

A thread watches them, so requests are answered meanwhile. Scoring stops on the page's request, when the
designer ends, or when no page has been open for 10 s.
"""

import threading
import time
from codecs import getincrementaldecoder
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from starlette.responses import FileResponse, Response

from khep_twin import playpen as playpens
from khep_twin.errors import ChallengeError, StoppedError, choices, user_error_text
from khep_twin.lab.challenge.attempt import Attempt, score_file
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile, load, names
from khep_twin.lab.challenge.results import participants, rank_attempts, score_files, to_csv
from khep_twin.process.machine import n_cores
from khep_twin.web import requests
from khep_twin.web.answers import Actions, action
from khep_twin.web.documents import PROGRAM_SUFFIXES, Documents
from khep_twin.web.messages import Publish, Scored, Scoring
from khep_twin.web.print_capture import PrintBuffer

_ENDING_S = 5.0
"""Longest time for a process to end with the designer [s]; a program that hangs takes 3.5."""

_PAGE_TIMEOUT = 10.0
"""Time without an open page after which scoring stops [s]; reloading a page takes less."""

_FLUSH_INTERVAL = 0.08
"""Shortest interval of messages with printed text [s]."""


class Challenges:
    """Challenges of the page, and the scoring in progress; `is_watched` returns whether a page is open."""

    def __init__(self, documents: Documents, publish: Publish, is_watched: Callable[[], bool]) -> None:
        self._documents = documents
        self._publish = publish
        self._is_watched = is_watched
        self._stop = threading.Event()
        self._start_lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._current: Scoring | None = None
        self._table: tuple[Challenge, list[Attempt]] | None = None

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        return {
            "challenges": action(requests.Request, self._list),
            "challenge-picture": action(
                requests.LibraryRequest, lambda request: FileResponse(_load_challenge(request.name).picture)
            ),
            "score": action(requests.ScoreRequest, self._score),
            "score-table": action(requests.ScoreTableRequest, self._score_table),
            "score-csv": action(requests.Request, self._csv),
            "score-stop": action(requests.Request, lambda request: self._stop.set()),
        }

    def close(self) -> None:
        """End the scoring and its process."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_ENDING_S)

    def _list(self, request: requests.Request) -> dict[str, object]:
        """Return the challenges by name, and the message of the scoring in progress."""
        return {"challenges": {name: _describe(load(name)) for name in names()}, "now": self._current}

    def _score(self, request: requests.ScoreRequest) -> None:
        file = _load_challenge(request.challenge)
        path = file.solution if request.program is None else self._program(request.program)
        name = "reference solution" if request.program is None else request.program
        output = PrintBuffer(self._publish, "score-printed")
        flush_time = 0.0
        decode = getincrementaldecoder("utf-8")("replace").decode

        def work(is_over: Callable[[], bool]) -> None:
            def stop() -> bool:
                nonlocal flush_time
                if (now := time.monotonic()) > flush_time + _FLUSH_INTERVAL:
                    flush_time = now
                    output.flush()
                return is_over()

            attempt = score_file(file, str(path), show=lambda data: output.add(decode(data)), stop=stop)
            output.flush()
            self._publish(_scored_message(file.challenge, name, self._with_relative_names(attempt)))

        self._start({"kind": "scoring", "challenge": request.challenge, "program": name}, work)

    def _score_table(self, request: requests.ScoreTableRequest) -> None:
        file = _load_challenge(request.challenge)
        root = self._documents.root
        paths = participants(self._documents.below(request.folder))
        files = [self._program(path.relative_to(root).as_posix()) for path in paths]
        rows: list[Attempt] = []

        def add_row(attempt: Attempt, part: float) -> None:
            rows.append(self._with_relative_names(attempt))
            self._publish({"kind": "score-rows", "part": part, "rows": _table_rows(file.challenge, rows)})

        def work(is_over: Callable[[], bool]) -> None:
            self._table = file.challenge, rows
            score_files(file, files, jobs=max(n_cores() // 2, 1), on_result=add_row, stop=is_over)

        self._start({"kind": "scoring", "challenge": request.challenge, "folder": request.folder}, work)

    def _csv(self, request: requests.Request) -> Response:
        if self._table is None or not self._table[1]:
            raise ChallengeError("no program of a folder was scored yet")
        return Response(to_csv(*self._table), media_type="application/octet-stream")

    def _program(self, name: str) -> Path:
        path = self._documents.path(name, *PROGRAM_SUFFIXES)
        if not path.is_file():
            raise ChallengeError(
                "not found", file=name, expected="a program below the folder of the designer"
            )
        return path

    def _with_relative_names(self, attempt: Attempt) -> Attempt:
        """Return an attempt with file names relative to the folder."""
        relative = self._documents.relative
        return replace(attempt, file=relative(attempt.file), reason=relative(attempt.reason))

    def _start(self, message: Scoring, work: Callable[[Callable[[], bool]], None]) -> None:
        """Start a thread that calls `work` with a function that returns whether scoring must stop.

        Raises:
            ChallengeError: Another scoring is in progress.
        """
        with self._start_lock:
            if self._current is not None:
                subject = self._current.get("program") or f"the folder {self._current.get('folder')}"
                raise ChallengeError(f"{subject} is being scored; expected to wait for it, or to stop it")
            self._stop.clear()
            self._current = message
            self._publish(message)
            self._thread = threading.Thread(target=self._run, args=(work,), name="scoring", daemon=True)
            self._thread.start()

    def _run(self, work: Callable[[Callable[[], bool]], None]) -> None:
        """Score in this thread, and publish the end."""
        watched_time = time.monotonic()
        text = ""

        def is_over() -> bool:
            nonlocal watched_time
            if self._is_watched():
                watched_time = time.monotonic()
            return self._stop.is_set() or time.monotonic() > watched_time + _PAGE_TIMEOUT

        try:
            work(is_over)
        except StoppedError:
            text = "stopped"
        except BaseException as error:  # reported in the page; a fault is then raised as usual
            text = user_error_text(error) or f"{type(error).__name__}: {error}"
            if user_error_text(error) is None:
                raise
        finally:
            self._current = None
            self._publish({"kind": "score-ended", "text": text})


def _load_challenge(name: str) -> ChallengeFile:
    """Return a challenge of the package.

    Raises:
        ChallengeError: There is none of this name.
    """
    if name not in names():
        raise ChallengeError(f"{name}: no such challenge; {choices(name, names())}")
    return load(name)


def _describe(file: ChallengeFile) -> dict[str, object]:
    """Return a challenge as the page shows it."""
    challenge = file.challenge
    penalties = [f"{penalty.each:g} for each of {penalty.metric}" for penalty in challenge.penalties]
    facts = {
        "metric": challenge.reading,
        "penalty": ", ".join(penalties),
        "time": challenge.length,
        "passed": challenge.passing_scores,
        "reference": "" if challenge.reference is None else challenge.value(challenge.reference),
    }
    return {
        "title": challenge.title,
        "description": challenge.description.strip(),
        "playpen": challenge.playpen if challenge.playpen in playpens.names() else None,
        "facts": {name: text for name, text in facts.items() if text},
    }


def _scored_message(challenge: Challenge, program: str, attempt: Attempt) -> Scored:
    """Return the result of a program as the page shows it."""
    if attempt.score is None:
        return {"kind": "scored", "program": program, "score": None, "reason": attempt.reason}
    return {
        "kind": "scored",
        "program": program,
        "score": challenge.value(attempt.score.value),
        "runs": [challenge.value(value) for value in attempt.score.runs],
        "passes": challenge.passes(attempt.score.value),
        "threshold": challenge.passing_scores,
        "reference": None if challenge.reference is None else challenge.value(challenge.reference),
    }


def _table_rows(challenge: Challenge, finished: list[Attempt]) -> list[dict[str, object]]:
    """Return the rows of a table, best first."""
    return [
        {
            "rank": rank,
            "participant": Path(attempt.file).stem,
            "score": "" if attempt.score is None else f"{attempt.score.value:.4g}",
            "passes": None if attempt.score is None else challenge.passes(attempt.score.value),
            "note": attempt.note,
        }
        for rank, attempt in rank_attempts(challenge, finished)
    ]
