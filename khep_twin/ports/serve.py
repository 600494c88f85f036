"""Server of a twin: a loop that advances its world by a clock and exchanges bytes with its host ports."""

import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Protocol

from khep_twin.clock import NEVER_NS, NS_PER_S, Pacer
from khep_twin.ports.connection import Connection
from khep_twin.ports.event_sources import set_exact_timeouts
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.process.machine import wait_readable
from khep_twin.units import TICK_NS

LONGEST_WAIT_S = 0.02
"""Longest wall time of one cycle of the loop, as some hosts cannot wake it [s]."""

CHECK_INTERVAL_WALL_NS = NS_PER_S // 200
"""Wall time after which hosts that have not woken the loop are also checked [ns]."""

FLUSH_INTERVAL_WALL_NS = NS_PER_S // 2
"""Wall time after which the log is written to disk [ns]."""

WIRE_SPEED = 0.0
"""Speed of the wire clock: only the bytes on the line take time."""

MANY_ROBOTS = 4
"""Number of robots from which plain code needs more processor time than their lines in real time."""


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
        ports: Ports for the hosts of its robots, one for each.
        speed: Simulated seconds per second of wall time; inf without pacing, WIRE for the wire clock.
        stop: Callback that is called once per cycle; True stops the server.
        notify: Callback for notices to the user, such as a wrong baud rate; by default they are warnings.

    Returns:
        The pacer, with the number and sum of the delays that could not be caught up.
    """
    connections = [
        Connection(twin, robot, port, notify) for robot, port in zip(twin.robots, ports, strict=True)
    ]
    # Loading compiled code later would make hosts wait for half a second.
    twin.world.code.switch_step = None
    pacer = Pacer(speed if 0 < speed < math.inf else 1.0, twin.world.time_ns)
    if speed == WIRE_SPEED:
        _serve_by_wire(twin, connections, stop)
    elif math.isinf(speed):
        _serve_unpaced(twin, connections, stop)
    else:
        set_exact_timeouts()
        _serve_by_clock(twin, connections, pacer, stop)
    return pacer


def _serve_by_clock(
    twin: Twin, connections: Sequence[Connection], pacer: Pacer, stop: Callable[[], bool]
) -> None:
    """Advance by the wall clock."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = PeriodicFlush(twin), _HostWait(connections)

    def update_due_ns() -> int:
        """Return the time that is due, after dropping a delay that is too long to catch up."""
        if late_ns := pacer.slip(world.time_ns):
            world.log_event(None, f"the simulation fell behind by {late_ns / 1e6:.1f} ms and gave them up")
        return pacer.due_ns()

    while not stop():
        # Wait for the next command, the robots' next byte or the next control tick, whichever is first.
        tick_ns, event_ns = world.time_ns + TICK_NS, _next_event_ns(connections)
        active_connections, due_ns = wait(pacer.wait_s(min(tick_ns, event_ns))), 0
        if not active_connections or event_ns != NEVER_NS:
            due_ns = update_due_ns()
            # Bytes that are due are not delayed by the duration of the simulation.
            for connection in connections:
                connection.deliver_early(due_ns)
        for connection in active_connections:
            # On a line without delay, a command that has just arrived is already due.
            due_ns = max(connection.receive(update_due_ns), due_ns)
        due_ns = due_ns or update_due_ns()
        advance_to(max(min(due_ns, tick_ns), world.time_ns))
        for connection in connections:
            connection.deliver()
        flush()


def _serve_unpaced(twin: Twin, connections: Sequence[Connection], stop: Callable[[], bool]) -> None:
    """Advance as fast as possible."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = PeriodicFlush(twin), _HostWait(connections)
    while not stop():
        for connection in wait(0.0):
            connection.receive()
        advance_to(max(min(world.time_ns + TICK_NS, _next_event_ns(connections)), world.time_ns))
        for connection in connections:
            connection.deliver()
        flush()


def _serve_by_wire(twin: Twin, connections: Sequence[Connection], stop: Callable[[], bool]) -> None:
    """Advance only for the bytes of commands and replies; a reply follows its command immediately."""
    world, advance_to = twin.world, twin.time_source.advance_to
    flush, wait = PeriodicFlush(twin), _HostWait(connections)
    while not stop():
        if active_connections := wait(LONGEST_WAIT_S):
            for connection in active_connections:
                connection.receive()
            while (next_ns := min([connection.next_stop_ns() for connection in connections])) != NEVER_NS:
                advance_to(max(next_ns, world.time_ns))
                for connection in connections:
                    connection.deliver()
        flush()


def _next_event_ns(connections: Sequence[Connection]) -> int:
    """Return the time of the next command or byte on a robot's line [ns]."""
    return min([connection.next_ns() for connection in connections])


class _HostWait:
    """Wait for bytes, for hosts that connect or leave, or for a time-out."""

    def __init__(self, connections: Sequence[Connection]) -> None:
        self._connections = connections
        self._sources: dict[int, Connection] | None = None
        self._last_check_ns = 0

    def __call__(self, duration: float) -> Sequence[Connection]:
        """Wait at most `duration` [s]; return the connections to be checked.

        Some hosts cannot wake the loop, so all are checked regularly.
        """
        connections = self._connections
        if (sources := self._sources) is None:
            sources = {fd: connection for connection in connections for fd in connection.descriptors()}
            # The descriptors change when a connection is checked, and when a line has room again.
            self._sources = sources if all(connection.has_room for connection in connections) else None
        ready_descriptors = wait_readable(sources, min(max(duration, 0.0), LONGEST_WAIT_S))
        time_ns = time.monotonic_ns()
        if time_ns - self._last_check_ns >= CHECK_INTERVAL_WALL_NS:
            self._last_check_ns = time_ns
            active = connections
        else:
            active = tuple({sources[fd]: None for fd in ready_descriptors})
        if active:
            self._sources = None
        return active


class Flushable(Protocol):
    """A log, or a listener on a line, that can be flushed."""

    def flush(self) -> None:
        """Write all buffered records."""


class PeriodicFlush:
    """Flush of a log to the file system every FLUSH_INTERVAL_WALL_NS."""

    def __init__(self, log: Flushable) -> None:
        self._log = log
        self._last_flush_wall_ns = time.monotonic_ns()

    def __call__(self) -> None:
        """Flush if the interval has passed."""
        if time.monotonic_ns() - self._last_flush_wall_ns > FLUSH_INTERVAL_WALL_NS:
            self._log.flush()
            self._last_flush_wall_ns = time.monotonic_ns()
