"""A tap on a line: nothing of it is lost, and nothing waits for who listens."""

import os
import socket

from khep_twin.shadow.tap import Tap, TappedLine

never = bool


class Clock:
    """A clock of a line, a millisecond further each time it is read."""

    now_ns = 0

    def __call__(self) -> int:
        self.now_ns += 1_000_000
        return self.now_ns


def test_bytes_come_in_order_with_their_times_and_silence_is_told() -> None:
    here, there = socket.socketpair()
    with here, there:
        tap = Tap(here.fileno(), Clock())
        tap.on_bytes(True, b"N\n")
        tap.on_bytes(False, b"n,1")
        tap.flush()
        tap.close()
        here.close()
        found = list(TappedLine(there.fileno(), never))
    assert [(each.to_robot, each.data) for each in found] == [(True, b"N\n"), (False, b"n,1"), (True, b"")]
    times_ns = [each.time_ns for each in found]
    assert times_ns == sorted(set(times_ns))


def test_a_listener_that_sleeps_delays_nothing_and_loses_nothing() -> None:
    here, there = socket.socketpair()
    sent = [os.urandom(1000) for _ in range(2000)]
    with here, there:
        tap = Tap(here.fileno(), Clock())
        for data in sent:  # Nobody reads: what the pipe does not take would block.
            tap.on_bytes(False, data)
        line, found = iter(TappedLine(there.fileno(), never)), list[bytes]()
        while len(found) < len(sent):
            tap.flush()
            found += filter(None, [next(line).data])
    assert found == sent


def test_a_listener_that_has_gone_is_noticed_and_costs_nothing() -> None:
    here, there = socket.socketpair()
    with here:
        tap = Tap(here.fileno(), Clock())
        there.close()
        for _ in range(10):
            tap.on_bytes(True, b"N\n")
        assert tap.broken
        tap.close()


def test_a_listener_ends_where_it_is_asked_to() -> None:
    here, there = socket.socketpair()
    with here, there:
        assert list(TappedLine(there.fileno(), lambda: True)) == []
