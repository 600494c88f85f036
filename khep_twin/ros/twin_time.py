"""Simulated time of a twin in this process, which its node publishes, and work between its steps."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from math import isinf
from threading import Condition

from khep_twin.clock import NEVER_NS, NS_PER_S, Pacer
from khep_twin.errors import KhepTwinError
from khep_twin.world import World

TICK_NS = NS_PER_S // 50
"""Interval of the published time, that of the samples of a log [ns]."""

_REPEAT_INTERVAL = 0.2
"""Interval at which a paused twin publishes its time again, for late subscribers [s of wall time]."""


class TwinTime:
    """Source of simulated time for the ports of a twin: paced by the wall clock, unpaced, or in single steps.

    Args:
        world: World of the twin.
        speed: Simulated seconds per second; inf without pacing.
        step_ns: Time of a step [ns]; None if time is not paused.
        publish: Function that publishes the time [ns], never 0.
    """

    def __init__(
        self, world: World, speed: float, step_ns: int | None, publish: Callable[[int], None]
    ) -> None:
        self._world, self._publish = world, publish
        self._step_ns = step_ns
        self._pacer = None if isinf(speed) or step_ns is not None else Pacer(speed, world.time_ns)
        self._limit_ns = NEVER_NS if step_ns is None else world.time_ns
        self._tick_ns = world.time_ns + TICK_NS
        self._condition = Condition()
        self._actions: deque[tuple[Callable[[], object], Future[None]]] = deque()
        self._steps: list[Future[None]] = []
        self._is_ended = False

    # From threads --------------------------------------------------------------------------------------

    def request(self, action: Callable[[], object]) -> Future[None]:
        """Have the world's thread do something between two steps."""
        return self._submit(lambda future: self._actions.append((action, future)))

    def step(self) -> Future[None]:
        """Let one step of time pass, after earlier ones."""

        def allow(future: Future[None]) -> None:
            self._limit_ns += self._step_ns or 0
            self._steps.append(future)

        return self._submit(allow)

    def _submit(self, store: Callable[[Future[None]], None]) -> Future[None]:
        future = Future[None]()
        with self._condition:
            if self._is_ended:
                future.set_exception(_ended())
            else:
                store(future)
                self._condition.notify()
        return future

    def end(self) -> None:
        """Let time pass without waits, so that the programs on the lines can end; refuse further work."""
        with self._condition:
            self._is_ended, self._limit_ns = True, NEVER_NS
            for future in [*self._steps, *(future for _, future in self._actions)]:
                future.set_exception(_ended())
            self._steps.clear()
            self._actions.clear()
            self._condition.notify()

    # The world's thread --------------------------------------------------------------------------------

    def attend(self) -> None:
        """Do nothing: requested work is done when time passes."""

    def advance_to(self, time_ns: int) -> None:
        """Return when simulated time has reached `time_ns` [ns]."""
        while True:
            self._act()
            now_ns = self._world.time_ns
            next_ns = min(time_ns, self._tick_ns, self._limit_ns)
            wait = 0.0 if self._pacer is None or self._is_ended else self._pacer.wait_s(next_ns)
            if time_ns <= now_ns:
                return
            if next_ns <= now_ns:
                self._pause()
            elif wait > 0:
                self._wait(wait)
            else:
                self._advance(next_ns)

    def _advance(self, time_ns: int) -> None:
        self._world.advance_to(time_ns)
        if self._pacer is not None:
            self._pacer.slip(time_ns)
        if time_ns >= self._tick_ns:
            self._tick_ns += TICK_NS
            self._publish(time_ns)

    def _act(self) -> None:
        """Do the requested work."""
        while True:
            with self._condition:
                if not self._actions:
                    return
                action, future = self._actions.popleft()
            try:
                action()
                future.set_result(None)
            except KhepTwinError as error:
                future.set_exception(error)

    def _pause(self) -> None:
        """Report finished steps, wait for the next one, and publish the time again."""
        with self._condition:
            if self._world.time_ns < self._limit_ns:
                return  # a step came meanwhile
            for future in self._steps:
                future.set_result(None)
            self._steps.clear()
            self._wait(_REPEAT_INTERVAL)
        if self._world.time_ns:
            self._publish(self._world.time_ns)

    def _wait(self, wait: float) -> None:
        """Wait for a wall time [s], or for work."""
        with self._condition:
            if not self._actions and not self._is_ended:
                self._condition.wait(wait)


def _ended() -> KhepTwinError:
    return KhepTwinError("the twin has ended")
