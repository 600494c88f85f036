"""Rate limit of the notices that hosts cause."""

import time
from collections.abc import Iterable

_AT_ONCE = 10
"""Notices that may follow each other."""

_INTERVAL = 10.0
"""Time per further notice [s]."""


class NoticeLimit:
    """Rate limit of notices, ten at once and six a minute: no host fills the log or blocks standard error."""

    def __init__(self) -> None:
        self._room = float(_AT_ONCE)
        self._since = time.monotonic()
        self._dropped = 0

    def admit(self, notices: Iterable[str]) -> list[str]:
        """Return the notices to be printed; the next one gives the number of those that were not."""
        now = time.monotonic()
        self._room = min(self._room + (now - self._since) / _INTERVAL, _AT_ONCE)
        self._since = now
        printed: list[str] = []
        for notice in notices:
            if self._room < 1:
                self._dropped += 1
                continue
            self._room -= 1
            rest = f" ({self._dropped} more notices were not printed)" if self._dropped else ""
            printed.append(notice + rest)
            self._dropped = 0
        return printed
