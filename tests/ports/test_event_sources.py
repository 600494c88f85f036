"""Sources that wake the serving loop."""

import os
import threading
from pathlib import Path

import pytest

from khep_twin.ports.event_sources import Event, open_events, set_exact_timeouts
from khep_twin.ports.pty import PtyPort


def test_only_the_thread_that_wants_them_has_exact_timeouts() -> None:
    slack_file = Path(f"/proc/{threading.get_native_id()}/timerslack_ns")
    if not slack_file.exists():
        pytest.skip("this system has no timerslack_ns")
    before, inside = slack_file.read_text(), list[str]()

    def ask() -> None:
        set_exact_timeouts()
        inside.append(Path(f"/proc/{threading.get_native_id()}/timerslack_ns").read_text())

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert inside == ["1\n"]
    assert slack_file.read_text() == before


def test_more_events_than_fit_a_read_are_returned_at_once() -> None:
    with PtyPort() as port:
        events = open_events(port.name)
        if events is None:
            pytest.skip("this system has no inotify")
        for _ in range(200):
            os.close(os.open(port.name, os.O_RDWR | os.O_NOCTTY))
        assert events.drain() == [Event.OPENED, Event.CLOSED] * 200
        assert not events.drain()
        events.close()
