"""Time of a watched twin: paced by the wall clock; it can be paused, stepped and sped up.

It stands between a world and the code that advances its time, such as a controller's port in lock-step.
Between two slices of time it handles the user's requests and an outside host on the robot's line.

Without a program of the page, that host uses the line as with `khep-twin serve`. With one, its commands are
inserted between the program's: one whole line at a time, with its own reply. They delay the program, as they
would on one cable.
"""

import math
import select
import time
from collections import deque
from collections.abc import Callable, Sequence

from khep_twin.board.protocol import LINE_ENDS
from khep_twin.clock import NEVER_NS, Pacer
from khep_twin.errors import KhepTwinError
from khep_twin.ports.connection import Connection
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.robot import Robot
from khep_twin.units import TICK_NS

_LINE_LIMIT = 1024
"""Longest incomplete line that is held back [bytes]."""

LONGEST_WAIT = 0.02
"""Longest wall time of one wait [s]."""

PICTURE_INTERVAL = 0.04
"""Shortest wall time between two pictures [s]."""

STEP_NS = 10 * TICK_NS
"""Time of one step while paused [ns]."""

_LISTENING_INTERVAL = 0.002
"""Wall time between two polls of the hosts while a program runs: each costs system calls [s]."""

_LAST_CYCLE_S = 1.0
"""Longest time for a stopped controller to finish its cycle [s of wall time]."""


class OutsideHost:
    """Host at the far end of one robot's cable.

    Args:
        twin: Twin whose world the robot is in.
        robot: Robot of the line.
        port: Cable to the host.
        notify: Callback that takes notices for the user.

    Attributes:
        commands: Number of lines inserted so far.
    """

    def __init__(self, twin: Twin, robot: Robot, port: HostPort, notify: Callable[[str], None]) -> None:
        self.robot, self.port = robot, port
        self.commands = 0
        self._alone = Connection(twin, robot, port, notify)
        self._notify = notify
        self._begun = bytearray()

    def descriptors(self) -> Sequence[int]:
        """Return the descriptors to wait for."""
        return self._alone.descriptors()

    def next_ns(self) -> int:
        """Return the time of the next event on the line [ns]."""
        return self._alone.next_ns()

    def exchange(self, now: Callable[[], int] | None) -> None:
        """Pass bytes in both directions, with no other program on the line."""
        if self._begun:
            self.robot.send(bytes(self._begun))
            self._begun.clear()
        self._alone.take(now)
        self._alone.give()

    def speak_between(self, pass_time: Callable[[int], None]) -> None:
        """Execute one line of the host if there is one and no reply is pending."""
        uart = self.robot.uart
        if len(uart.rx) or len(uart.tx):
            return
        answered = not any(end in self._begun for end in LINE_ENDS)
        received = self.port.receive(max(_LINE_LIMIT - len(self._begun), 0), answered)
        for notice in received.notices:
            self._notify(notice)
        if received.left:
            # The host's last bytes still reach the robot; the answers are dropped.
            if last := bytes(self._begun) + received.last:
                self.robot.send(last)
            self.robot.disconnect()
            self._begun.clear()
        self._begun += received.data
        end = next((at for at, byte in enumerate(self._begun) if byte in LINE_ENDS), -1)
        if end < 0:
            if len(self._begun) >= _LINE_LIMIT:
                self._begun.clear()
            return
        line = bytes(self._begun[: end + 1])
        del self._begun[: end + 1]
        self.commands += 1
        self.robot.send(line)
        while (next_ns := self._alone.next_ns()) != NEVER_NS:
            pass_time(next_ns)
            self._alone.give()


class SessionEndedError(KhepTwinError):
    """A stopped program on a paced twin that did not end by itself."""


class PacedTwin:
    """Time source that paces a twin's time, also for programs in lock-step.

    Args:
        twin: Twin to pace.
        hosts: Outside hosts, one for each robot on the line.
        show: Callback for a picture, up to 25 times a second.

    Attributes:
        world: World of the twin.
        robots: Robots of the twin.
        view: Twin for the ports of programs; closing it keeps the world.
        speed: Simulated seconds per second; inf for as fast as possible.
        paused: True if time stands still.
        ended: True if the twin must end.
        driven: Robots whose lines are used by programs in lock-step.
    """

    def __init__(self, twin: Twin, hosts: Sequence[OutsideHost], show: Callable[[], None]) -> None:
        self.world, self.robots = twin.world, twin.robots
        self.view = Twin(twin.world, twin.robots, twin.options, self)
        self._twin = twin
        # Loading compiled code would stop the picture for a moment.
        twin.world.code.switch_at = None
        self.speed = 1.0
        self.paused = False
        self.ended = False
        self.driven: Sequence[Robot] = []
        self._hosts, self._show_picture = hosts, show
        self._requests: deque[Callable[[], None]] = deque()
        self._steps_left_ns = 0
        self._stop_at: float | None = None
        self._broken_off = False
        self._pacer = Pacer(1.0, self.world.time_ns)
        self._paced_by: float | None = None
        self._shown = self._listened = 0.0

    def request(self, action: Callable[[], None]) -> None:
        """Have the twin's thread execute an action between two slices of time; from any thread."""
        self._requests.append(action)  # a deque's own lock suffices

    def step(self) -> None:
        """Advance one step while paused."""
        self._steps_left_ns += STEP_NS

    def stop_program(self, wanted: bool = True) -> None:
        """Request the end of the program in lock-step, or allow the next one to begin."""
        self._stop_at = time.monotonic() + _LAST_CYCLE_S if wanted else None
        self._broken_off = False

    def stopping(self) -> bool:
        """Return whether the program must end."""
        return self.ended or self._stop_at is not None

    def advance_to(self, time_ns: int) -> None:
        """Advance to `time_ns` [ns] at the selected speed, and handle requests meanwhile."""
        world = self.world
        while world.time_ns < time_ns:
            self.attend()
            self._slice(min(time_ns, world.time_ns + TICK_NS))

    def idle(self) -> None:
        """Advance to the next event, with only outside hosts on the lines."""
        self.attend()
        world = self.world
        next_ns = min([world.time_ns + TICK_NS, *(host.next_ns() for host in self._hosts)])
        self._slice(max(next_ns, world.time_ns))

    def attend(self) -> None:
        """Execute requests, wait while time is paused, and exchange bytes with outside hosts.

        Raises:
            SessionEndedError: A stopped program did not end in time.
        """
        while True:
            while self._requests:
                self._requests.popleft()()
            if self.ended or self._stop_at is not None or not self.paused:
                break
            if self._steps_left_ns >= TICK_NS:
                self._steps_left_ns -= TICK_NS
                break
            self._picture()
            self._wait(LONGEST_WAIT)
        late = self.ended or (self._stop_at is not None and time.monotonic() > self._stop_at)
        if self.driven and late and not self._broken_off:
            # Only once: the commands that stop the motors must still pass.
            self._broken_off = True
            raise SessionEndedError("stopped within a cycle")
        if not self.driven:
            for host in self._hosts:
                host.exchange(None if self.paused else self._due_ns)
        elif time.monotonic() - self._listened >= _LISTENING_INTERVAL:
            self._listened = time.monotonic()
            for host in self._hosts:
                if host.robot in self.driven:
                    host.speak_between(self._slice)
                else:
                    host.exchange(None)
        self._picture()

    def end(self) -> None:
        """Complete the log."""
        self._twin.close()

    def _slice(self, time_ns: int) -> None:
        """Wait until a time is due, and advance the world to it."""
        pacer = self._pacer_now()
        if pacer is not None and not self.paused and not self.stopping():
            while (left := pacer.wait(time_ns)) > 0 and not self._requests and not self._wait(left):
                pass
            if not self.driven:
                # Bytes of a host that arrived meanwhile must not wait until then.
                time_ns = max(min(pacer.due_ns(), time_ns), self.world.time_ns)
        self.world.advance_to(time_ns)
        if pacer is not None:
            pacer.slip(self.world.time_ns)

    def _pacer_now(self) -> Pacer | None:
        wanted = None if self.paused or not math.isfinite(self.speed) else self.speed
        if wanted != self._paced_by:
            self._paced_by = wanted
            if wanted is not None:
                self._pacer = Pacer(wanted, self.world.time_ns)
        return None if wanted is None else self._pacer

    def _due_ns(self) -> int:
        pacer = self._pacer_now()
        return self.world.time_ns if pacer is None else max(pacer.due_ns(), self.world.time_ns)

    def _wait(self, duration: float) -> bool:
        """Wait for a duration, or until a host sends; return whether one did."""
        descriptors = [] if self.driven else [each for host in self._hosts for each in host.descriptors()]
        return bool(select.select(descriptors, [], [], min(duration, LONGEST_WAIT))[0])

    def _picture(self) -> None:
        now = time.monotonic()
        if now - self._shown >= PICTURE_INTERVAL:
            self._shown = now
            self._show_picture()
