"""What wakes the serving loop."""

import threading
from pathlib import Path

import pytest

from khep_twin.ports.event_sources import exact_timeouts


def test_only_the_thread_that_wants_them_has_exact_timeouts() -> None:
    own = Path(f"/proc/{threading.get_native_id()}/timerslack_ns")
    if not own.exists():
        pytest.skip("this system has no timerslack_ns")
    before, inside = own.read_text(), list[str]()

    def ask() -> None:
        exact_timeouts()
        inside.append(Path(f"/proc/{threading.get_native_id()}/timerslack_ns").read_text())

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert inside == ["1\n"]
    assert own.read_text() == before
