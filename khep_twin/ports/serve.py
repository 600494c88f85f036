"""Serving a twin in real time: one loop between the wall clock, the world and a pseudo-terminal."""

import math
import select
import signal
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

from khep_twin.clock import NS_PER_S, Pacer
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.twin import Twin
from khep_twin.units import TICK_NS

LONGEST_WAIT = 0.1
"""After so much wall time the loop looks up, however slow the twin is [s]."""

FLUSH_NS = NS_PER_S // 2
"""Wall time after which the log is on disk at the latest [ns]."""


def serve(twin: Twin, port: PtyPort, speed: float, *, stop: Callable[[], bool]) -> Pacer:
    """Lets a host at `port` talk to the twin until `stop` says so.

    Args:
        twin: what is served.
        port: where the host is.
        speed: simulated seconds per second of wall time; inf for as fast as it goes.
        stop: asked once a turn.

    Returns:
        The pacer, which knows how often and how much time had to be given up.
    """
    world, robot, uart = twin.world, twin.robot, twin.robot.uart
    paced = math.isfinite(speed)
    pacer = Pacer(speed if paced else 1.0, world.time_ns)
    flushed_ns = time.monotonic_ns()
    while not stop():
        # On to the next command, the robot's next byte or the next control tick, whatever is first.
        events_ns = (world.time_ns + TICK_NS, robot.next_command_ns(), uart.tx.next_ns)
        next_ns = max(min(event_ns for event_ns in events_ns if event_ns is not None), world.time_ns)
        wait = min(max(pacer.wait(next_ns), 0.0), LONGEST_WAIT) if paced else 0.0
        readable = port.descriptor in select.select(port.descriptors if uart.room else [], [], [], wait)[0]
        twin.advance_to(max(min(pacer.due_ns(), next_ns), world.time_ns) if paced else next_ns)
        gone = port.last_host_left()
        if readable or gone:
            robot.send(port.read(uart.room))
        if gone:
            # What it has sent still reaches the robot, as on a cable; what it has left behind is cleared.
            port.clear()
            robot.hang_up()
        reply = uart.tx.read(world.time_ns)
        if reply and port.hosts != 0:
            port.write(reply)
        if paced and (late_ns := pacer.slip(world.time_ns)):
            world.tell(None, f"the simulation fell behind by {late_ns / 1e6:.1f} ms and gave them up")
        if twin.recorder is not None and time.monotonic_ns() - flushed_ns > FLUSH_NS:
            twin.recorder.flush()
            flushed_ns = time.monotonic_ns()
    return pacer


@contextmanager
def stopping() -> Generator[Callable[[], bool], None, None]:
    """Says whether the process was asked to end, by SIGINT, SIGTERM or SIGHUP.

    Asked once, it is left to come to an end by itself; asked again by SIGINT, it is interrupted.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
