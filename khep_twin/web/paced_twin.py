"""Time of a watched twin: paced by the wall clock; it can be paused, stepped and sped up.

`PacedTwin` is a time source between a world and the code that advances its time, for example a controller's
port in lock-step. Between two slices of time it handles the page's requests, which are its mailbox, and an
outside host on the robot's line.

Without a program of the page, this host uses the line as with `khep-twin serve`. With one, its commands are
inserted between those of the program: one line at a time, with its reply. They delay the program, as on a
shared cable. States of the program:

    running --stop_program--> stopping --its cycle takes over 1 s--> interrupted
"""

import math
import time
from collections import deque
from collections.abc import Callable, Sequence

from khep_twin.clock import NEVER_NS, Pacer
from khep_twin.errors import KhepTwinError
from khep_twin.ports.connection import Connection
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.process.machine import wait_readable
from khep_twin.robots.robot import Robot
from khep_twin.units import TICK_NS

_LINE_LIMIT = 1024
"""Length to which an incomplete line is truncated [bytes]; the robot truncates it to fewer."""

LONGEST_WAIT = 0.02
"""Longest wall time of one wait [s]."""

PICTURE_INTERVAL = 0.04
"""Shortest wall time between two pictures [s]."""

STEP_NS = 10 * TICK_NS
"""Time of one step while paused [ns]."""

_HOST_POLL_INTERVAL = 0.002
"""Wall time between two polls of the hosts while a program runs, as a poll costs system calls [s]."""

_LAST_CYCLE_S = 1.0
"""Longest time for a stopped controller to finish its cycle [s of wall time]."""


class OutsideHost:
    """Host at the far end of one robot's cable; `commands` is the number of its inserted lines."""

    def __init__(self, twin: Twin, robot: Robot, port: HostPort, notify: Callable[[str], None]) -> None:
        self.robot = robot
        self.port = port
        self.commands = 0
        self._world = twin.world
        self._connection = Connection(twin, robot, port, notify)
        self._notify = notify
        self._partial_line = bytearray()
        self._dialect = robot.dialect
        self._stop_requests: deque[bytes] = deque()
        self._awaits_stop_reply = False

    def stop_motors(self) -> None:
        """Send the requests that stop the motors at the next exchanges, and drop their replies."""
        framing, requests = self._dialect.framing, self._dialect.stop_requests
        # The host's unfinished request ends first.
        self._stop_requests.extend([framing.resync, *map(framing.encode, requests)])

    def descriptors(self) -> Sequence[int]:
        """Return the descriptors to wait for."""
        return self._connection.descriptors()

    def next_ns(self) -> int:
        """Return the time of the next event on the line [ns]."""
        return self._connection.next_ns()

    def exchange(self, now: Callable[[], int] | None) -> None:
        """Pass bytes in both directions, with no other program on the line."""
        if self._partial_line:
            self.robot.send(bytes(self._partial_line))
            self._partial_line.clear()
        if self._stop_requests or self._awaits_stop_reply:
            self._exchange_stop_request()
        else:
            self._connection.receive(now)
            self._connection.deliver()

    def _exchange_stop_request(self) -> None:
        """Send a stop request after the host's replies, or drop the bytes of its reply."""
        if not self._awaits_stop_reply:
            self._connection.deliver()
        elif self.robot.uart.tx.next_ns is not None:
            self.robot.uart.tx.read(self._world.time_ns)
        if self._connection.next_ns() != NEVER_NS:
            return
        self._awaits_stop_reply = bool(self._stop_requests)
        if self._stop_requests:
            self.robot.send(self._stop_requests.popleft())

    def insert_command(self, pass_time: Callable[[int], None]) -> None:
        """Execute one line of the host if there is one and no reply is pending."""
        uart = self.robot.uart
        if len(uart.rx) or len(uart.tx):
            return
        is_incomplete = not self._request_length()
        received = self.port.receive(_LINE_LIMIT if is_incomplete else 0, is_incomplete)
        for notice in received.notices:
            self._notify(notice)
        if received.hosts_left:
            # The host's last bytes still reach the robot; the replies are dropped.
            if last_data := bytes(self._partial_line) + received.last_data:
                self.robot.send(last_data)
            self.robot.disconnect()
            self._partial_line.clear()
        self._partial_line += received.data
        if not (length := self._request_length()):
            del self._partial_line[_LINE_LIMIT:]
            return
        line = bytes(self._partial_line[:length])
        del self._partial_line[:length]
        self.commands += 1
        self.robot.send(line)
        while (next_ns := self._connection.next_ns()) != NEVER_NS:
            pass_time(next_ns)
            self._connection.deliver()

    def _request_length(self) -> int:
        """Return the length of the host's first complete request; 0 without one."""
        length = self._dialect.framing.length(self._partial_line, to_robot=True)
        return length if length <= len(self._partial_line) else 0


class SessionEndedError(KhepTwinError):
    """A stopped program on a paced twin that did not end in time."""


class PacedTwin:
    """Time source that paces a twin's time, also for programs in lock-step, which wait for simulated time.

    Args:
        twin: Twin to pace.
        hosts: Outside hosts, one for each robot on the line.
        publish_picture: Callback for a picture, up to 25 times a second.

    Attributes:
        world: World of the twin.
        robots: Robots of the twin.
        program_twin: Twin for the ports of programs; closing it keeps the world.
        speed: Simulated seconds per second; inf for as fast as possible.
        paused: True if time stands still.
        is_ending: True if the twin must end.
        driven: Robots whose lines are used by programs in lock-step.
    """

    def __init__(self, twin: Twin, hosts: Sequence[OutsideHost], publish_picture: Callable[[], None]) -> None:
        self.world = twin.world
        self.robots = twin.robots
        self.program_twin = Twin(twin.world, twin.robots, twin.options, self)
        # Loading compiled code would stop the picture for a moment.
        twin.world.code.switch_step = None
        self.speed = 1.0
        self.paused = False
        self.is_ending = False
        self.driven: Sequence[Robot] = []
        self._hosts = hosts
        self._publish_picture = publish_picture
        self._requests: deque[Callable[[], None]] = deque()
        self._steps_left_ns = 0
        self._stop_at: float | None = None
        self._is_interrupted = False
        self._pacer: Pacer | None = None
        self._picture_time = 0.0
        self._poll_time = 0.0

    def request(self, action: Callable[[], None]) -> None:
        """Have the twin's thread execute an action between two slices of time; from any thread."""
        self._requests.append(action)  # appending to a deque is atomic

    def step(self) -> None:
        """Advance one step while paused."""
        self._steps_left_ns += STEP_NS

    def stop_motors(self) -> None:
        """Have the motors of all robots stopped."""
        for host in self._hosts:
            host.stop_motors()

    def stop_program(self, stop: bool = True) -> None:
        """Request the end of the program in lock-step, or allow the next one to start."""
        self._stop_at = time.monotonic() + _LAST_CYCLE_S if stop else None
        self._is_interrupted = False

    def is_stopping(self) -> bool:
        """Return whether the program must end."""
        return self.is_ending or self._stop_at is not None

    def advance_to(self, time_ns: int) -> None:
        """Advance to `time_ns` [ns] at the selected speed, and handle requests meanwhile."""
        while self.world.time_ns < time_ns:
            self.attend()
            self._slice(min(time_ns, self.world.time_ns + TICK_NS))

    def idle(self) -> None:
        """Advance to the next event, with only outside hosts on the lines."""
        self.attend()
        next_ns = min([self.world.time_ns + TICK_NS, *(host.next_ns() for host in self._hosts)])
        self._slice(max(next_ns, self.world.time_ns))

    def attend(self) -> None:
        """Execute requests, wait while time is paused, and exchange bytes with outside hosts.

        Raises:
            SessionEndedError: A stopped program did not end in time.
        """
        while True:
            while self._requests:
                self._requests.popleft()()
            if self.is_stopping() or not self.paused:
                break
            if self._steps_left_ns >= TICK_NS:
                self._steps_left_ns -= TICK_NS
                break
            self._publish_if_due()
            self._wait(LONGEST_WAIT)
        late = self.is_ending or (self._stop_at is not None and time.monotonic() > self._stop_at)
        if self.driven and late and not self._is_interrupted:
            # Once per program: the commands that stop its motors must still pass.
            self._is_interrupted = True
            raise SessionEndedError("stopped within a cycle")
        if not self.driven:
            for host in self._hosts:
                host.exchange(None if self.paused else self._due_ns)
        elif time.monotonic() - self._poll_time >= _HOST_POLL_INTERVAL:
            self._poll_time = time.monotonic()
            for host in self._hosts:
                if host.robot in self.driven:
                    host.insert_command(self._slice)
                else:
                    host.exchange(None)
        self._publish_if_due()

    def _slice(self, time_ns: int) -> None:
        """Wait until a time is due, and advance the world to it."""
        pacer = self._current_pacer()
        if pacer is not None and not self.paused and not self.is_stopping():
            while (wait_s := pacer.wait_s(time_ns)) > 0 and not self._requests and not self._wait(wait_s):
                pass
            if not self.driven:
                # A host's bytes that arrived meanwhile must not wait until `time_ns`.
                time_ns = max(min(pacer.due_ns(), time_ns), self.world.time_ns)
        self.world.advance_to(time_ns)
        if pacer is not None:
            pacer.slip(self.world.time_ns)

    def _current_pacer(self) -> Pacer | None:
        """Return the pacer of the present speed; None while paused or without a limit."""
        speed = self.speed  # which other threads may change
        if self.paused or not math.isfinite(speed):
            self._pacer = None
        elif self._pacer is None or self._pacer.speed != speed:
            self._pacer = Pacer(speed, self.world.time_ns)
        return self._pacer

    def _due_ns(self) -> int:
        pacer = self._current_pacer()
        return self.world.time_ns if pacer is None else max(pacer.due_ns(), self.world.time_ns)

    def _wait(self, duration: float) -> bool:
        """Wait for a duration, or until a host sends; return whether one did."""
        hosts = () if self.driven else self._hosts
        descriptors = [descriptor for host in hosts for descriptor in host.descriptors()]
        return bool(wait_readable(descriptors, min(duration, LONGEST_WAIT)))

    def _publish_if_due(self) -> None:
        now = time.monotonic()
        if now - self._picture_time >= PICTURE_INTERVAL:
            self._picture_time = now
            self._publish_picture()
