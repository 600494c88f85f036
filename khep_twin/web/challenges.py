"""Challenges in the page: one program, or a folder of them, is scored at a time, in its own process.

A thread watches that process, so requests are answered meanwhile. It ends when the page asks for it, when the
designer ends, and when no page is open any more.
"""

import threading
import time
from codecs import getincrementaldecoder
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from starlette.responses import FileResponse, Response

from khep_twin import playpen as playpens
from khep_twin.errors import ChallengeError, KhepTwinError, StoppedError, choices
from khep_twin.lab.challenge.attempt import Attempt, score_file
from khep_twin.lab.challenge.challenge import Challenge, ChallengeFile, load, names
from khep_twin.lab.challenge.results import attempts, participants, ranked, to_csv
from khep_twin.machine import n_cores
from khep_twin.web import requests
from khep_twin.web.answers import Actions, on
from khep_twin.web.documents import PROGRAMS, Documents
from khep_twin.web.messages import Publish, Scored, Scoring
from khep_twin.web.session import PrintBuffer

_ENDING_S = 5.0
"""Longest time for a process to end with the designer [s]; a file that hangs takes 3.5."""

_UNWATCHED = 10.0
"""Time without an open page after which scoring ends [s]; a page that is loaded again takes less."""

_TELL = 0.08
"""Shortest time between two messages of printed text [s]."""

Over = Callable[[], bool]
"""Function that returns whether the scoring is to end."""


class Challenges:
    """Challenges of the page, and what is being scored.

    Args:
        documents: Files of the folder.
        publish: Function that takes messages for the page.
        watched: Function that returns whether a page is open.
    """

    def __init__(self, documents: Documents, publish: Publish, watched: Callable[[], bool]) -> None:
        self._documents, self._publish, self._watched = documents, publish, watched
        self._stop, self._starting = threading.Event(), threading.Lock()
        self._thread: threading.Thread | None = None
        self._now: Scoring | None = None
        self._table: tuple[Challenge, list[Attempt]] | None = None

    @property
    def actions(self) -> Actions:
        """Actions by name."""
        return {
            "challenges": on(requests.Request, self._list),
            "challenge-picture": on(
                requests.Library, lambda asked: FileResponse(_shipped(asked.name).picture)
            ),
            "score": on(requests.ScoreRequest, self._score),
            "score-table": on(requests.ScoreTableRequest, self._score_table),
            "score-csv": on(requests.Request, self._csv),
            "score-stop": on(requests.Request, lambda asked: self._stop.set()),
        }

    def close(self) -> None:
        """End the scoring and its process."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_ENDING_S)

    def _list(self, asked: requests.Request) -> dict[str, object]:
        """Return the challenges by name, and the message of what is being scored."""
        return {"challenges": {name: _described(load(name)) for name in names()}, "now": self._now}

    def _score(self, asked: requests.ScoreRequest) -> None:
        file = _shipped(asked.challenge)
        path = file.solution if asked.program is None else self._program(asked.program)
        name = "reference solution" if asked.program is None else asked.program
        printed, told = PrintBuffer(self._publish, "score-printed"), 0.0
        decoder = getincrementaldecoder("utf-8")("replace")

        def work(over: Over) -> None:
            def stop() -> bool:
                nonlocal told
                if (now := time.monotonic()) > told + _TELL:
                    told = now
                    printed.tell()
                return over()

            found = score_file(
                file, str(path), show=lambda data: printed.add(decoder.decode(data)), stop=stop
            )
            printed.tell()
            self._publish(_told(file.challenge, name, self._named(found)))

        self._begin({"kind": "scoring", "challenge": asked.challenge, "program": name}, work)

    def _score_table(self, asked: requests.ScoreTableRequest) -> None:
        file = _shipped(asked.challenge)
        root = self._documents.root
        found = participants(self._documents.below(asked.folder))
        files = [self._program(str(path.relative_to(root))) for path in found]
        rows: list[Attempt] = []

        def done(each: Attempt, part: float) -> None:
            rows.append(self._named(each))
            self._publish({"kind": "score-rows", "part": part, "rows": _rows(file.challenge, rows)})

        def work(over: Over) -> None:
            self._table = file.challenge, rows
            attempts(file, files, jobs=max(n_cores() // 2, 1), done=done, stop=over)

        self._begin({"kind": "scoring", "challenge": asked.challenge, "folder": asked.folder}, work)

    def _csv(self, asked: requests.Request) -> Response:
        if self._table is None or not self._table[1]:
            raise ChallengeError("no program of a folder was scored yet")
        return Response(to_csv(*self._table), media_type="application/octet-stream")

    def _program(self, name: str) -> Path:
        path = self._documents.path(name, *PROGRAMS)
        if not path.is_file():
            raise ChallengeError(
                "not found", file=name, expected="a program below the folder of the designer"
            )
        return path

    def _named(self, found: Attempt) -> Attempt:
        """Return an attempt whose file has its name in the folder."""
        relative = self._documents.relative
        return replace(found, file=relative(found.file), reason=relative(found.reason))

    def _begin(self, message: Scoring, work: Callable[[Over], None]) -> None:
        """Start a thread that scores.

        Raises:
            ChallengeError: Something is being scored.
        """
        with self._starting:
            if self._now is not None:
                what = self._now.get("program") or f"the folder {self._now.get('folder')}"
                raise ChallengeError(f"{what} is being scored; expected to wait for it, or to stop it")
            self._stop.clear()
            self._now = message
            self._publish(message)
            self._thread = threading.Thread(target=self._run, args=(work,), name="scoring", daemon=True)
            self._thread.start()

    def _run(self, work: Callable[[Over], None]) -> None:
        seen, text = time.monotonic(), ""

        def over() -> bool:
            nonlocal seen
            if self._watched():
                seen = time.monotonic()
            return self._stop.is_set() or time.monotonic() > seen + _UNWATCHED

        try:
            work(over)
        except StoppedError:
            text = "stopped"
        except KhepTwinError as error:
            text = error.plain
        except BaseException as error:  # reported in the page, then raised as usual
            text = f"{type(error).__name__}: {error}"
            raise
        finally:
            self._now = None
            self._publish({"kind": "score-ended", "text": text})


def _shipped(name: str) -> ChallengeFile:
    """Return a challenge that ships with the package.

    Raises:
        ChallengeError: There is none of this name.
    """
    if name not in names():
        raise ChallengeError(f"{name}: no such challenge; {choices(name, names())}")
    return load(name)


def _described(file: ChallengeFile) -> dict[str, object]:
    """Return what the page shows of a challenge."""
    challenge = file.challenge
    penalties = [f"{each.each:g} for each of {each.metric}" for each in challenge.penalties]
    facts = {
        "metric": challenge.reading,
        "penalty": ", ".join(penalties),
        "time": challenge.length,
        "passed": challenge.wanted,
        "reference": "" if challenge.reference is None else challenge.value(challenge.reference),
    }
    return {
        "title": challenge.title,
        "description": challenge.description.strip(),
        "playpen": challenge.playpen if challenge.playpen in playpens.names() else None,
        "facts": {name: text for name, text in facts.items() if text},
    }


def _told(challenge: Challenge, program: str, found: Attempt) -> Scored:
    """Return the result of a program as the page shows it."""
    if found.score is None:
        return {"kind": "scored", "program": program, "score": None, "reason": found.reason}
    return {
        "kind": "scored",
        "program": program,
        "score": challenge.value(found.score.value),
        "runs": [challenge.value(each) for each in found.score.runs],
        "passes": challenge.passes(found.score.value),
        "threshold": challenge.wanted,
        "reference": None if challenge.reference is None else challenge.value(challenge.reference),
    }


def _rows(challenge: Challenge, found: list[Attempt]) -> list[dict[str, object]]:
    """Return the rows of a table, the best first."""
    return [
        {
            "rank": rank,
            "participant": Path(each.file).stem,
            "score": "" if each.score is None else f"{each.score.value:.4g}",
            "passes": None if each.score is None else challenge.passes(each.score.value),
            "note": each.note,
        }
        for rank, each in ranked(challenge, found)
    ]
