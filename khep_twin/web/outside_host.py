"""An outside host on the serial line of a robot that a program of the page may be driving, too.

Without such a program, it uses the line as with `khep-twin serve`. With one, its commands are inserted
between the program's: one whole line at a time, with its own reply. They delay the program, as they would on
one cable.
"""

from collections.abc import Callable, Sequence

from khep_twin.board.protocol import LINE_ENDS
from khep_twin.clock import NEVER_NS
from khep_twin.ports.connection import Connection
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.robot import Robot

_LINE_LIMIT = 1024
"""Longest incomplete line that is held back [bytes]."""


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
        self._alone.exchange(now)

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
