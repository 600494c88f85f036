"""A bound on the notices that hosts can make a server print."""

import time
from collections.abc import Iterable

_AT_ONCE = 10
"""Notices that may follow each other."""

_INTERVAL = 10.0
"""Time that gives room for one more [s]."""


class Ration:
    """Rate limit of notices, ten at once and six a minute: no host fills the log or blocks standard error."""

    def __init__(self) -> None:
        self._room = float(_AT_ONCE)
        self._since = time.monotonic()
        self._untold = 0

    def told(self, notices: Iterable[str]) -> list[str]:
        """Return the notices to be printed; the next one gives the number of those that were not."""
        now = time.monotonic()
        self._room = min(self._room + (now - self._since) / _INTERVAL, _AT_ONCE)
        self._since = now
        told: list[str] = []
        for notice in notices:
            if self._room < 1:
                self._untold += 1
                continue
            self._room -= 1
            told.append(f"{notice} ({self._untold} more notices were not told)" if self._untold else notice)
            self._untold = 0
        return told
