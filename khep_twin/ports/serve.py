"""Serving a twin: one loop between a clock, the world and the cables of its robots' hosts."""

import math
import select
import time
from collections.abc import Callable, Sequence

from khep_twin.clock import NS_PER_S, Pacer
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.recorder import Recorder
from khep_twin.ports.connection import Connection
from khep_twin.ports.event_sources import exact_timeouts
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.units import TICK_NS

LONGEST_WAIT = 0.02
"""Longest wall time between two turns of the loop, as some hosts cannot wake it [s]."""

FLUSH_NS = NS_PER_S // 2
"""Wall time after which the log is on disk at the latest [ns]."""

WIRE = 0.0
"""Speed of the wire clock: only the bytes on the line take time."""


def serve(
    twin: Twin,
    ports: Sequence[HostPort],
    speed: float,
    *,
    stop: Callable[[], bool],
    notify: Callable[[str], None],
) -> Pacer:
    """Connect hosts to the twin until `stop` returns True.

    Args:
        twin: Twin to serve.
        ports: Cables to the hosts of its robots, one for each.
        speed: Simulated seconds per second of wall time; inf for as fast as it goes, WIRE for the wire clock.
        stop: Callback that is called once per cycle; True ends it.
        notify: Callback that takes notices for the user, such as a wrong speed of the line.

    Returns:
        The pacer, with the number and sum of the times that had to be given up.
    """
    connections = [
        Connection(twin, robot, port, notify) for robot, port in zip(twin.robots, ports, strict=True)
    ]
    pacer = Pacer(speed if 0 < speed < math.inf else 1.0, twin.world.time_ns)
    if speed == WIRE:
        _serve_by_wire(twin, connections, stop)
    else:
        exact_timeouts()
        _serve_by_clock(twin, connections, pacer if math.isfinite(speed) else None, stop)
    return pacer


def _serve_by_clock(
    twin: Twin, connections: Sequence[Connection], pacer: Pacer | None, stop: Callable[[], bool]
) -> None:
    """Advance with the wall clock, or as fast as possible without a pacer."""
    world = twin.world
    flush = Flush(twin.recorder)
    while not stop():
        # On to the next command, the robots' next byte or the next control tick, whatever is first.
        next_ns = min(
            [world.time_ns + TICK_NS, *(time_ns for each in connections for time_ns in each.events_ns())]
        )
        next_ns = max(next_ns, world.time_ns)
        _wait(connections, 0.0 if pacer is None else pacer.wait(next_ns))
        due_ns = next_ns if pacer is None else pacer.due_ns()
        twin.advance_to(max(min(due_ns, next_ns), world.time_ns))
        for connection in connections:
            connection.exchange(None if pacer is None else pacer.due_ns)
        if pacer is not None and (late_ns := pacer.slip(world.time_ns)):
            world.log_event(None, f"the simulation fell behind by {late_ns / 1e6:.1f} ms and gave them up")
        flush()


def _serve_by_wire(twin: Twin, connections: Sequence[Connection], stop: Callable[[], bool]) -> None:
    """Advance only for bytes: those of a command, and those of its reply, which comes at once."""
    flush = Flush(twin.recorder)
    while not stop():
        _wait(connections, LONGEST_WAIT)
        for connection in connections:
            connection.exchange()
        while events := [time_ns for each in connections for time_ns in each.events_ns()]:
            twin.advance_to(max(min(events), twin.world.time_ns))
            for connection in connections:
                connection.give()
        flush()


def _wait(connections: Sequence[Connection], duration: float) -> None:
    """Wait for bytes, for hosts that come or go, or until a duration is over [s]."""
    descriptors = [descriptor for each in connections for descriptor in each.descriptors()]
    select.select(descriptors, [], [], min(max(duration, 0.0), LONGEST_WAIT))


class Flush:
    """Flush of a log, if there is one, to the file system each FLUSH_NS of wall time."""

    def __init__(self, log: Recorder | LineRecorder | None) -> None:
        self._log = log
        self._flushed_ns = time.monotonic_ns()

    def __call__(self) -> None:
        """Flush if it is time to."""
        if self._log is not None and time.monotonic_ns() - self._flushed_ns > FLUSH_NS:
            self._log.flush()
            self._flushed_ns = time.monotonic_ns()
