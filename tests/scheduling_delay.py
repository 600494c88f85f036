"""Delay of the scheduler, for tests in real time: a busy machine is no mistake of theirs."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

_NAP = 0.002


class SchedulingDelay:
    """The longest that a sleeper overslept [s], measured while it is open."""

    def __init__(self) -> None:
        self.worst = 0.0
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._sleep, name="scheduling_delay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop measuring."""
        self._ends.set()
        self._thread.join()

    def excuse(self, limit: float) -> None:
        """Skip the test if the machine was later than it may be for what is asserted next [s]."""
        if self.worst > limit:
            pytest.skip(
                f"this machine is busy: it woke a sleeper {self.worst:.3f} s late, the test bears {limit} s"
            )

    def _sleep(self) -> None:
        while not self._ends.is_set():
            begin = time.monotonic()
            time.sleep(_NAP)
            self.worst = max(self.worst, time.monotonic() - begin - _NAP)


@contextmanager
def scheduling_delay() -> Iterator[SchedulingDelay]:
    """Measure the delay of the scheduler."""
    late = SchedulingDelay()
    try:
        yield late
    finally:
        late.close()
