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
    host_end, receiver = socket.socketpair()
    with host_end, receiver:
        sender = LineSender(host_end.fileno(), Clock())
        sender.on_bytes(True, b"N\n")
        sender.on_bytes(False, b"n,1")
        sender.flush()
        sender.close()
        host_end.close()
        chunks = list(LineReceiver(receiver.fileno(), never))
    assert [(chunk.to_robot, chunk.data) for chunk in chunks] == [
        (True, b"N\n"),
        (False, b"n,1"),
        (True, b""),
    ]
    times_ns = [chunk.time_ns for chunk in chunks]
    assert times_ns == sorted(set(times_ns))


def test_a_listener_that_sleeps_delays_nothing_and_loses_nothing() -> None:
    host_end, receiver = socket.socketpair()
    sent = [os.urandom(1000) for _ in range(2000)]
    with host_end, receiver:
        sender = LineSender(host_end.fileno(), Clock())
        for data in sent:  # Nobody reads: what the pipe does not take would block.
            sender.on_bytes(False, data)
        line, chunks = iter(LineReceiver(receiver.fileno(), never)), list[bytes]()
        while len(chunks) < len(sent):
            sender.flush()
            chunks += filter(None, [next(line).data])
    assert chunks == sent


def test_a_listener_that_has_gone_is_noticed_and_costs_nothing() -> None:
    host_end, receiver = socket.socketpair()
    with host_end:
        sender = LineSender(host_end.fileno(), Clock())
        receiver.close()
        for _ in range(10):
            sender.on_bytes(True, b"N\n")
        assert sender.is_broken
        sender.close()


def test_a_listener_ends_where_it_is_asked_to() -> None:
    sender, receiver = socket.socketpair()
    with sender, receiver:
        assert list(LineReceiver(receiver.fileno(), lambda: True)) == []
