"""Serving a twin: one loop between a clock, the world and the cables of its robots' hosts."""

import math
import select
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Protocol

from khep_twin.clock import NEVER_NS, NS_PER_S, Pacer
from khep_twin.ports.connection import Connection
from khep_twin.ports.event_sources import exact_timeouts
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.units import TICK_NS

LONGEST_WAIT = 0.02
"""Longest wall time between two turns of the loop, as some hosts cannot wake it [s]."""

LOOK_NS = NS_PER_S // 200
"""Wall time after which hosts that have not woken the loop are looked after, too [ns]."""

FLUSH_NS = NS_PER_S // 2
"""Wall time after which the log is on disk at the latest [ns]."""

WIRE = 0.0
"""Speed of the wire clock: only the bytes on the line take time."""

MANY = 4
"""Robots from which on plain code takes more of a processor in real time than their lines."""


def serve(
    twin: Twin,
    ports: Sequence[HostPort],
    speed: float = 1.0,
    *,
    stop: Callable[[], bool] = lambda: False,
    notify: Callable[[str], None] = warnings.warn,
) -> Pacer:
    """Connect hosts to the twin until `stop` returns True, or until the process is interrupted.

        with open_twin("obstacles") as twin, PtyPort("./khepera") as port:
            serve(twin, [port])  # hosts open ./khepera

    Args:
        twin: Twin to serve.
        ports: Cables to the hosts of its robots, one for each.
        speed: Simulated seconds per second of wall time; inf for as fast as it goes, WIRE for the wire clock.
        stop: Callback that is called once per cycle; True ends it.
        notify: Callback that takes notices for the user, such as a wrong speed of the line; by default they
            are warnings.

    Returns:
        The pacer, with the number and sum of the times that had to be given up.
    """
    connections = [
        Connection(twin, robot, port, notify) for robot, port in zip(twin.robots, ports, strict=True)
    ]
    # Loading compiled code takes half a second, for which no host should have to wait.
    twin.world.code.switch_at = None
    pacer = Pacer(speed if 0 < speed < math.inf else 1.0, twin.world.time_ns)
    if speed == WIRE:
        _serve_by_wire(twin, connections, stop)
    elif math.isinf(speed):
        _serve_at_once(twin, connections, stop)
    else:
        exact_timeouts()
        _serve_by_clock(twin, connections, pacer, stop)
    return pacer


def _serve_by_clock(
    twin: Twin, connections: Sequence[Connection], pacer: Pacer, stop: Callable[[], bool]
) -> None:
    """Advance with the wall clock."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = Flush(twin), _Waiting(connections)

    def now() -> int:
        """Return the time that is due; what has to be given up is, before a host's bytes are given a time."""
        if late_ns := pacer.slip(world.time_ns):
            world.log_event(None, f"the simulation fell behind by {late_ns / 1e6:.1f} ms and gave them up")
        return pacer.due_ns()

    while not stop():
        # On to the next command, the robots' next byte or the next control tick, whatever is first.
        tick_ns, event_ns = world.time_ns + TICK_NS, _next_ns(connections)
        callers, due_ns = wait(pacer.wait(min(tick_ns, event_ns))), 0
        if not callers or event_ns != NEVER_NS:
            due_ns = now()
            # The simulation of what is due takes time, for which bytes that are due do not wait.
            for connection in connections:
                connection.give_early(due_ns)
        for connection in callers:
            # Without time on the line, a command that has just come is due already.
            due_ns = max(connection.take(now), due_ns)
        due_ns = due_ns or now()
        advance_to(max(min(due_ns, tick_ns), world.time_ns))
        for connection in connections:
            connection.give()
        flush()


def _serve_at_once(twin: Twin, connections: Sequence[Connection], stop: Callable[[], bool]) -> None:
    """Advance as fast as possible."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = Flush(twin), _Waiting(connections)
    while not stop():
        for connection in wait(0.0):
            connection.take()
        advance_to(max(min(world.time_ns + TICK_NS, _next_ns(connections)), world.time_ns))
        for connection in connections:
            connection.give()
        flush()


def _serve_by_wire(twin: Twin, connections: Sequence[Connection], stop: Callable[[], bool]) -> None:
    """Advance only for bytes: those of a command, and those of its reply, which comes at once."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = Flush(twin), _Waiting(connections)
    while not stop():
        if callers := wait(LONGEST_WAIT):
            for connection in callers:
                connection.take()
            while (next_ns := min([each.next_stop_ns() for each in connections])) != NEVER_NS:
                advance_to(max(next_ns, world.time_ns))
                for connection in connections:
                    connection.give()
        flush()


def _next_ns(connections: Sequence[Connection]) -> int:
    """Return the time of the next command or byte on a robot's line [ns]."""
    return min([connection.next_ns() for connection in connections])


class _Waiting:
    """Wait for bytes, for hosts that come or go, or until a duration is over."""

    def __init__(self, connections: Sequence[Connection]) -> None:
        self._connections = connections
        self._callers: dict[int, Connection] | None = None
        self._looked_ns = 0

    def __call__(self, duration: float) -> Sequence[Connection]:
        """Wait at most `duration` [s]; return the connections whose hosts are to be looked after.

        Some hosts cannot wake the loop, so all are looked after regularly.
        """
        connections = self._connections
        if (callers := self._callers) is None:
            callers = {each: connection for connection in connections for each in connection.descriptors()}
            # What wakes the loop changes when a host is looked after, and when a line has room again.
            self._callers = callers if all(each.has_room for each in connections) else None
        ready = select.select(callers, [], [], min(max(duration, 0.0), LONGEST_WAIT))[0]
        time_ns = time.monotonic_ns()
        if time_ns - self._looked_ns >= LOOK_NS:
            self._looked_ns, called = time_ns, connections
        else:
            called = tuple({callers[each]: None for each in ready})
        if called:
            self._callers = None
        return called


class Flushed(Protocol):
    """Interface of a log, or of a listener on a line, to be flushed."""

    def flush(self) -> None:
        """Pass on everything so far."""
        ...


class Flush:
    """Flush of a log to the file system each FLUSH_NS of wall time."""

    def __init__(self, log: Flushed) -> None:
        self._log = log
        self._flushed_ns = time.monotonic_ns()

    def __call__(self) -> None:
        """Flush if it is time to."""
        if time.monotonic_ns() - self._flushed_ns > FLUSH_NS:
            self._log.flush()
            self._flushed_ns = time.monotonic_ns()
