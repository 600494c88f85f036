"""Scheduler of the robots' programs: which thread runs next, and when simulated time passes.

All threads of all programs and of their child processes share one simulated time. Each has a connection to
the twin, sends requests on it and waits for their replies (`device_server`). A futex (fast user-space mutex)
is a word of a program's memory on which threads wait for each other; they queue here, not in the kernel.

    rule      | when                                                  | why
    ----------|-------------------------------------------------------|---------------------------------------
    one runs  | a request is served only while all threads wait: for  | threads do not race, so a run repeats
              | a reply, or in the kernel (`thread_watch`)            |
    start     | a new thread or process first requests HELLO          | it starts when it is its turn
    earliest  | the request that is due first is served; a SLEEP is   | simulated time passes until then
              | due at its end or wake, all others on arrival         |
    ties      | of several: by robot, then by thread number; last the | the order of a run repeats
              | futex waits, the longest first                        |
    clock     | a request for the time or a pin takes                 | a loop until some time or level ends
              | `TIME_REQUEST_NS`                                     |
    patience  | a thread computes for `PATIENCE_S` while requests are | the others continue: time passes as
              | pending                                               | fast as it computes, not deterministic
    external  | all wait, and the first is due never, or waits for a  | they wait for a key or the network:
              | socket until a time-out                               | time passes with the wall clock
    begin     | external waits of more than `SHORT_WAIT_S` count once | a wait for the kernel is short, and
              | they have lasted `EXTERNAL_WAIT_S` in all             | does not count
    between   | an external wait follows another that counted: it     | programs work between their waits for
              | also counts the time since, less what has passed      | the network, and stay in real time
    busy      | a thread computes or writes, and none requests, for   | it may never end: time passes with the
              | `BUSY_S`                                              | wall clock
"""

import os
import socket
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from operator import attrgetter

from khep_twin.programs.computer import Machine
from khep_twin.programs.thread_watch import ThreadWatch

TIME_REQUEST_NS = 10_000
"""Simulated time of a request for the time or a pin, and the code around it in a loop [ns] (assumed)."""

PATIENCE_S = 0.05
"""Processor time for which threads may compute while requests are pending [s] (assumed)."""

SHORT_WAIT_S = 0.001
"""Time of the wall clock for which all threads may wait for the kernel [s] (assumed)."""

EXTERNAL_WAIT_S = 0.02
"""Time of the wall clock in external waits, in all, from which they count [s] (assumed)."""

BUSY_S = 10.0
"""Time of the wall clock for which threads compute or write without a request [s] (assumed)."""

MAX_STEP_S = 1.0
"""Longest time of the wall clock that passes at once [s]: it may include a stop of the twin (Ctrl-Z)."""

NEVER_NS = (1 << 63) - 1
"""End of a wait without a time-out [ns]."""

STRIDE_NS = 1_000_000_000
"""Longest advance of simulated time before the programs are polled again: they may have ended [ns]."""

_MIN_POLL_S, _POLL_S = 0.0002, 0.02
"""Time of the wall clock between two polls while no request is due [s]: the second after a long wait."""


@dataclass(slots=True)
class ThreadConnection:
    """Connection of a thread, with its open request.

        running --request--> pending  --reply--> running    due on arrival
        running --SLEEP----> sleeping --reply--> running    due at its end, a WAKE of its futex or a CANCEL

    Attributes:
        is_pending: Whether a request is open, a SLEEP included.
        is_sleeping: Whether that is a SLEEP.
        is_external: Whether that also waits for another program, and so takes time of the wall clock.
        end_ns: End of the SLEEP [ns].
        futex: Process and address of its futex; address 0 for none.
        ticket: Rank in the queue of all futex waits; 0 for other requests.
        is_woken: Whether a WAKE has ended it.
        due_ns: Earliest time of the reply [ns].
    """

    socket: socket.socket
    robot: int
    process: int
    thread: int = 0
    kind: int = 0
    number: int = 0
    content: bytes = b""
    is_pending: bool = False
    is_sleeping: bool = False
    is_external: bool = False
    end_ns: int = 0
    futex: tuple[int, int] = (0, 0)
    ticket: int = 0
    is_woken: bool = False
    due_ns: int = 0


@dataclass
class Scheduler:
    """Order of requests, and simulated time.

    Attributes:
        machine: Machine whose time all share.
        connections: All connections, a view that changes with them.
        clock: Function that returns real time [ns]; None for simulated time.
        poll: Function that receives requests until a time-out [s], and returns whether any arrived.
        reply: Function that replies on a connection.
        on_wall_clock: Function that is called when time first passes with the wall clock.
    """

    machine: Machine
    connections: Collection[ThreadConnection]
    clock: Callable[[], int] | None
    poll: Callable[[float], bool]
    reply: Callable[[ThreadConnection], None]
    on_wall_clock: Callable[[], None]

    def __post_init__(self) -> None:
        self._wall_wait: tuple[bool, int] | None = None  # whether it is external, and its limit [ns]
        self._wait_start_s = self._counted_s = 0.0  # its start, and until when it was counted [s]
        self._last_count = 0.0, 0  # wall clock [s] and simulated time [ns] when a wait last counted
        self._external_s = 0.0  # total of external waits before they count
        self._last_ticket = 0
        self._last_wakes: dict[tuple[int, int], int] = {}  # last WAKE of each process and futex address

    def run(self, watch: ThreadWatch, should_stop: Callable[[], bool], end_ns: int) -> None:
        """Serve requests until a function returns True, or until a time [ns]."""
        assert sys.platform == "linux"
        start_ns, start_cpu_ns = 0, -1  # of a computation; -1 while all wait
        while self.machine.time_ns < end_ns and not should_stop():
            pending = [connection for connection in self.connections if connection.is_pending]
            key = attrgetter("due_ns", "ticket", "robot", "thread")
            connection = min(pending, key=key, default=None)
            if connection is not None and connection.due_ns == NEVER_NS:
                connection = None
            if self.clock is not None:
                if self.poll(0.0 if connection else _POLL_S):
                    continue
                if connection is None:
                    self.machine.advance_to(self.clock())
                else:
                    self._serve(connection, end_ns)
                continue
            all_wait = self._all_wait(watch, pending)
            due_ns = NEVER_NS if connection is None else connection.due_ns
            if connection is None or (all_wait and connection.is_external and due_ns > self.machine.time_ns):
                is_external = all_wait and (connection is not None or watch.is_external())
                self._wait(is_external, min(due_ns, end_ns))
                continue
            self._wall_wait = None
            if all_wait:
                if self.poll(0.0):
                    continue
                start_cpu_ns = -1
            else:
                if start_cpu_ns < 0:
                    start_ns, start_cpu_ns = self.machine.time_ns, watch.cpu_ns()
                spent_ns = watch.cpu_ns() - start_cpu_ns
                if spent_ns < PATIENCE_S * 1e9 or due_ns > start_ns + spent_ns:
                    self.poll(0.0001)
                    continue
            self._serve(connection, end_ns)
            os.sched_yield()  # to the thread with the reply, which mostly sends its next request
            self.poll(0.0)

    def pass_wall_time(self) -> None:
        """Advance by the time of the wall clock since the last call, if all threads wait for it."""
        if self._wall_wait is None:
            return
        is_external, limit_ns = self._wall_wait
        now_s = time.monotonic()
        elapsed_s = now_s - self._counted_s
        if not is_external and now_s - self._wait_start_s < BUSY_S:
            self._counted_s = now_s
            return
        if is_external and self._external_s < EXTERNAL_WAIT_S:
            if elapsed_s < SHORT_WAIT_S:
                return
            self._external_s = elapsed_s = self._external_s + elapsed_s
            if elapsed_s < EXTERNAL_WAIT_S:
                self._counted_s = now_s
                return
            self.on_wall_clock()
        self._counted_s = now_s
        step_ns = round(min(elapsed_s, MAX_STEP_S) * 1e9)
        self.machine.advance_to(min(self.machine.time_ns + step_ns, limit_ns))
        self._last_count = now_s, self.machine.time_ns

    def sleep(self, connection: ThreadConnection, end_ns: int, futex_address: int, last_wake: int) -> None:
        """Queue a wait until a time [ns], or until a WAKE of a futex after the last that its thread knows."""
        now_ns = self.machine.time_ns
        futex = connection.process, futex_address
        self._last_ticket += 1
        connection.end_ns = end_ns
        connection.futex = futex
        connection.ticket = self._last_ticket if futex_address else 0
        connection.is_woken = futex_address != 0 and last_wake < self._last_wakes.get(futex, 0)
        connection.due_ns = now_ns if connection.is_woken else max(end_ns, now_ns)

    def wake(self, futex: tuple[int, int], count: int, wake_number: int) -> None:
        """Wake those threads that have waited longest for a futex: a number of them, or all for 0."""
        self._last_wakes[futex] = wake_number
        waiting = [c for c in self.connections if c.is_sleeping and not c.is_woken and c.futex == futex]
        for connection in sorted(waiting, key=attrgetter("ticket"))[: count or None]:
            connection.due_ns = self.machine.time_ns
            connection.is_woken = True

    def _all_wait(self, watch: ThreadWatch, pending: Collection[ThreadConnection]) -> bool:
        """Return whether all threads wait, those with an open request included."""
        threads = {(connection.process, connection.thread) for connection in pending}
        blocked = {connection.thread for connection in pending if not connection.is_sleeping}
        return watch.all_wait(threads, blocked, len(self.connections))

    def _wait(self, is_external: bool, limit_ns: int) -> None:
        """Poll while no request is served; the wall clock counts by the rules external and busy."""
        now_s = time.monotonic()
        if self._wall_wait is None or self._wall_wait[0] != is_external:
            self._wait_start_s = self._counted_s = now_s
            if is_external and self._external_s >= EXTERNAL_WAIT_S:
                last_s, last_ns = self._last_count
                self._counted_s = min(now_s, last_s + (self.machine.time_ns - last_ns) / 1e9)
        self._wall_wait = is_external, limit_ns
        timeout_s = min(max(_MIN_POLL_S, (now_s - self._wait_start_s) / 4), _POLL_S)
        if is_external:
            timeout_s = min(timeout_s, max(limit_ns - self.machine.time_ns, 0) / 1e9)
        if not self.poll(timeout_s):
            self.pass_wall_time()

    def _serve(self, connection: ThreadConnection, end_ns: int) -> None:
        """Reply to a request, or advance by one stride towards its due time."""
        next_ns = min(self.machine.time_ns + STRIDE_NS, end_ns)
        if self.clock is None and connection.due_ns > next_ns:
            self.machine.advance_to(next_ns)
        else:
            self.reply(connection)
