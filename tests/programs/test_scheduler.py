"""Scheduler of the robots' programs: when the time of the wall clock passes."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from khep_twin.programs import scheduler
from khep_twin.programs.scheduler import BUSY_S, NEVER_NS, Scheduler

POLL_S = 0.25
"""Time of the wall clock that a poll takes [s]."""


class StoppedMachine:
    """A machine with a time only."""

    def __init__(self) -> None:
        self.time_ns = 0

    def advance_to(self, time_ns: int) -> None:
        """Advance."""
        self.time_ns = time_ns


def watch_of(all_wait: Callable[[], bool], is_external: bool) -> Any:
    """Return a watch of threads that all wait at some times."""

    def threads_wait(*_: object) -> bool:
        return all_wait()

    return SimpleNamespace(all_wait=threads_wait, cpu_ns=lambda: 0, is_external=lambda: is_external)


@pytest.mark.parametrize(
    ("wall_s", "simulated_s"), [(BUSY_S / 2, 0), (BUSY_S - POLL_S, 0), (BUSY_S + 3, 3 + POLL_S)]
)
def test_a_computation_without_requests_takes_wall_time_only_after_a_while(
    wall_s: float, simulated_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine: Any = StoppedMachine()
    watch = watch_of(lambda: False, is_external=False)
    start_s = now_s = 1000.0

    def poll(timeout_s: float) -> bool:
        nonlocal now_s
        now_s += POLL_S
        return False

    monkeypatch.setattr(scheduler, "time", SimpleNamespace(monotonic=lambda: now_s))
    idle = Scheduler(machine, [], None, poll, lambda _: None, lambda: None)
    idle.run(watch, lambda: now_s >= start_s + wall_s, NEVER_NS)
    assert machine.time_ns / 1e9 == pytest.approx(simulated_s)


@pytest.mark.parametrize(("slept_s", "gap_s"), [(0.0, 0.5), (0.25, 0.5), (5.0, 5.0)])
def test_a_server_that_works_between_its_waits_keeps_the_time_of_the_wall_clock(
    slept_s: float, gap_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine: Any = StoppedMachine()
    start_s = now_s = 1000.0

    def works() -> bool:
        return 2.0 < now_s - start_s <= 2.5

    def poll(timeout_s: float) -> bool:
        nonlocal now_s
        now_s += POLL_S
        if now_s - start_s == 2.5:
            machine.advance_to(machine.time_ns + round(slept_s * 1e9))
        return False

    watch = watch_of(lambda: not works(), is_external=True)
    monkeypatch.setattr(scheduler, "time", SimpleNamespace(monotonic=lambda: now_s))
    server = Scheduler(machine, [], None, poll, lambda _: None, lambda: None)
    server.run(watch, lambda: now_s >= start_s + 4, NEVER_NS)
    assert machine.time_ns / 1e9 == pytest.approx(4 - 0.5 + gap_s)
