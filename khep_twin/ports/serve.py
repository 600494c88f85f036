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
    world, uart = twin.world, twin.robot.uart
    pacer = Pacer(speed if math.isfinite(speed) else 1.0, world.time_ns)
    flushed_ns = time.monotonic_ns()
    while not stop():
        # Wait for the host's next byte, the robot's next byte or the next control tick, whatever is first.
        next_ns = min(world.time_ns + TICK_NS, uart.next_ns() or math.inf)
        wait = max(pacer.wait(int(next_ns)), 0.0) if math.isfinite(speed) else 0.0
        listening = [port.descriptor] if uart.room else []
        readable = bool(select.select(listening, [], [], wait)[0])
        now_ns = int(next_ns)
        if math.isfinite(speed):
            now_ns = max(min(pacer.due_ns(), now_ns), world.time_ns)
        twin.advance_to(now_ns)
        if readable:
            twin.robot.send(port.read(uart.room))
        reply = uart.tx.read(world.time_ns)
        if reply:
            port.write(reply)
        if math.isfinite(speed) and (late_ns := pacer.slip(world.time_ns)):
            world.tell(None, f"the simulation fell behind by {late_ns / 1e6:.1f} ms and gave them up")
        if twin.recorder is not None and time.monotonic_ns() - flushed_ns > FLUSH_NS:
            twin.recorder.flush()
            flushed_ns = time.monotonic_ns()
    return pacer


@contextmanager
def stopping() -> Generator[Callable[[], bool], None, None]:
    """Says whether the process was asked to end, by SIGINT or SIGTERM."""
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
