"""A line's pipe to a shadow: nothing of it is lost, and nothing waits for who listens."""

import os
import socket

from khep_twin.shadow.line_pipe import LineReceiver, LineSender

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
        sender = LineSender(here.fileno(), Clock())
        sender.on_bytes(True, b"N\n")
        sender.on_bytes(False, b"n,1")
        sender.flush()
        sender.close()
        here.close()
        found = list(LineReceiver(there.fileno(), never))
    assert [(each.to_robot, each.data) for each in found] == [(True, b"N\n"), (False, b"n,1"), (True, b"")]
    times_ns = [each.time_ns for each in found]
    assert times_ns == sorted(set(times_ns))


def test_a_listener_that_sleeps_delays_nothing_and_loses_nothing() -> None:
    here, there = socket.socketpair()
    sent = [os.urandom(1000) for _ in range(2000)]
    with here, there:
        sender = LineSender(here.fileno(), Clock())
        for data in sent:  # Nobody reads: what the pipe does not take would block.
            sender.on_bytes(False, data)
        line, found = iter(LineReceiver(there.fileno(), never)), list[bytes]()
        while len(found) < len(sent):
            sender.flush()
            found += filter(None, [next(line).data])
    assert found == sent


def test_a_listener_that_has_gone_is_noticed_and_costs_nothing() -> None:
    here, there = socket.socketpair()
    with here:
        sender = LineSender(here.fileno(), Clock())
        there.close()
        for _ in range(10):
            sender.on_bytes(True, b"N\n")
        assert sender.is_broken
        sender.close()


def test_a_listener_ends_where_it_is_asked_to() -> None:
    here, there = socket.socketpair()
    with here, there:
        assert list(LineReceiver(there.fileno(), lambda: True)) == []
