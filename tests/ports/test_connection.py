"""A connection of a robot's line to a host, and the loop that serves it, by cycles instead of by time."""

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import pytest

from khep_twin.board.uart import QUEUE_LIMIT, LineSettings
from khep_twin.clock import NEVER_NS
from khep_twin.playpen import Playpen
from khep_twin.ports import serve as serving
from khep_twin.ports.connection import Connection
from khep_twin.ports.host_port import NOTHING, Received
from khep_twin.ports.serve import WIRE_SPEED, serve
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

REPLY = b"b,5.02,5.01\r\n"


@dataclass
class Cable:
    """A host port that always wakes the loop, with a list of results."""

    descriptor: int
    news: list[Received] = field(default_factory=list[Received])
    written: list[bytes] = field(default_factory=list[bytes])
    path: str = "cable"
    dropped: int = 0
    occupied: bool = True
    bauds: list[int] = field(default_factory=list[int])

    def descriptors(self, has_room: bool) -> Sequence[int]:
        return [self.descriptor]

    def set_baud(self, baud: int) -> None:
        self.bauds.append(baud)

    def settings(self) -> LineSettings | None:
        return None

    def receive(self, limit: int, is_answered: bool = False) -> Received:
        return self.news.pop(0) if self.news else NOTHING

    def write(self, data: bytes, is_end: bool = False) -> None:
        self.written.append(data)

    def close(self) -> None:
        pass


@pytest.fixture
def cable() -> Iterator[Cable]:
    reader, writer = os.pipe()
    os.write(writer, b"x")
    yield Cable(reader, [Received(b"B\n")])
    os.close(reader)
    os.close(writer)


def cycles_limit(count: int) -> Callable[[], bool]:
    """Stop the loop after some cycles."""
    cycles = iter(range(count))
    return lambda: next(cycles, None) is None


def line_ns(n_bytes: int) -> int:
    return n_bytes * 11 * 10**9 // 9600


def open_asked_twin(cable: Cable) -> tuple[Twin, Connection]:
    """Open a twin that has just read a command and sends its reply."""
    twin = open_twin("default", TwinOptions())
    connection = Connection(twin, twin.robot, cable, print)
    connection.receive()
    twin.advance_to(connection.next_ns())
    return twin, connection


def test_bytes_that_are_due_do_not_wait_for_the_world(cable: Cable) -> None:
    twin, connection = open_asked_twin(cable)
    due_ns = connection.next_ns()
    connection.deliver()
    connection.deliver_early(due_ns - 1)
    assert cable.written == []
    connection.deliver_early(due_ns)
    assert cable.written == [b"b"]
    assert twin.world.time_ns < due_ns


def test_bytes_wait_for_the_world_while_a_command_may_wait_for_room(cable: Cable) -> None:
    twin, connection = open_asked_twin(cable)
    due_ns = connection.next_ns()
    cable.news.append(Received(b"B"))
    connection.receive()
    connection.deliver_early(due_ns)
    assert cable.written == []
    twin.advance_to(due_ns)
    connection.deliver()
    assert cable.written == [b"b"]


@pytest.mark.parametrize(("look_ns", "answered"), [(2**62, []), (0, [REPLY])])
def test_a_host_that_has_not_woken_the_loop_is_looked_after_regularly_alone(
    look_ns: int, answered: list[bytes], cable: Cable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serving, "CHECK_INTERVAL_WALL_NS", look_ns)
    scene = Playpen.load("swarm")
    scene = scene.model_copy(update={"robots": scene.robots[:2]})
    twin = open_twin(scene, TwinOptions(robot=None))
    reader, writer = os.pipe()
    quiet = Cable(reader, [Received(b"B\n")])
    serve(twin, [quiet, cable], WIRE_SPEED, stop=cycles_limit(1), notify=print)
    assert cable.written == [REPLY]
    assert quiet.written == answered
    os.close(reader)
    os.close(writer)


def test_an_idle_line_has_nothing_due(cable: Cable) -> None:
    twin = open_twin("default", TwinOptions())
    connection = Connection(twin, twin.robot, cable, print)
    assert connection.next_ns() == connection.next_stop_ns() == NEVER_NS


@pytest.mark.parametrize(
    ("sent", "bauds"), [(b"serial 38400\n", [9600, 38400]), (b"serial 38400\nrestart\n", [9600, 38400, 9600])]
)
def test_a_cable_is_told_the_speed_of_the_robots_line_whenever_it_changes(
    cable: Cable, sent: bytes, bauds: list[int]
) -> None:
    cable.news = [Received(sent)]
    twin, connection = open_asked_twin(cable)
    for _ in range(10):
        connection.receive()
        twin.advance_to(twin.world.time_ns + 100_000_000)
    assert cable.bauds == bauds


def test_a_reply_comes_in_one_piece_by_the_wire_clock_and_byte_by_byte_at_full_speed(cable: Cable) -> None:
    twin = open_twin("default", TwinOptions())
    serve(twin, [cable], WIRE_SPEED, stop=cycles_limit(1), notify=print)
    assert cable.written == [REPLY]
    assert twin.world.time_ns == line_ns(2) + line_ns(len(REPLY))
    cable.written.clear()
    cable.news.append(Received(b"B\n"))
    serve(twin, [cable], math.inf, stop=cycles_limit(50), notify=print)
    assert cable.written == [bytes((byte,)) for byte in REPLY]


@pytest.mark.parametrize("unpaced", [False, True])
def test_by_the_wire_clock_a_line_longer_than_the_queue_ends(cable: Cable, unpaced: bool) -> None:
    twin = open_twin("default", TwinOptions(unpaced=unpaced))
    cable.news[:] = [Received(b"x" * QUEUE_LIMIT), Received(b"x" * 10), Received(b"\nB\n")]
    serve(twin, [cable], WIRE_SPEED, stop=cycles_limit(3), notify=print)
    assert cable.written[-1].endswith(REPLY)
    waited_ns = 0 if unpaced else line_ns(QUEUE_LIMIT + 13)
    assert twin.world.time_ns >= waited_ns


@pytest.mark.parametrize("speed", [0.001, WIRE_SPEED, math.inf])
def test_without_time_on_the_line_the_turn_that_reads_a_command_answers_it(
    cable: Cable, speed: float
) -> None:
    twin = open_twin("default", TwinOptions(unpaced=True))
    serve(twin, [cable], speed, stop=cycles_limit(1), notify=print)
    assert cable.written == [REPLY]


def test_time_goes_on_while_hosts_wake_the_loop_and_send_nothing(cable: Cable) -> None:
    twin = open_twin("default", TwinOptions())
    end, count = 50_000_000, cycles_limit(100_000)
    serve(twin, [cable], 1000.0, stop=lambda: twin.world.time_ns >= end or count(), notify=print)
    assert twin.world.time_ns >= end


def test_a_command_is_not_answered_later_by_as_much_as_the_loop_was_held_up(
    cable: Cable, monkeypatch: pytest.MonkeyPatch
) -> None:
    twin, receive, end = open_twin("default", TwinOptions()), cable.receive, time.monotonic() + 20

    def receive_late(*arguments: Any) -> Received:
        if cable.news:
            time.sleep(0.5)
        return receive(*arguments)

    monkeypatch.setattr(cable, "receive", receive_late)
    is_done = lambda: b"".join(cable.written) == REPLY or time.monotonic() > end  # noqa: E731
    pacer = serve(twin, [cable], 1.0, stop=is_done, notify=print)
    assert pacer.slipped_ns >= 400_000_000
    assert twin.world.time_ns < 300_000_000
