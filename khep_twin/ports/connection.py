"""One robot of a served twin and the host at the far end of its cable."""

from collections.abc import Callable, Sequence

from khep_twin.ports.host_connection import Cable
from khep_twin.ports.twin import Twin
from khep_twin.robot import Robot


class Connection:
    """Carries bytes between a robot's line and its cable, and watches how the host treats its end.

    Args:
        twin: the world of the robot.
        robot: at this end.
        cable: to the host.
        tell: takes what somebody should see.
    """

    def __init__(self, twin: Twin, robot: Robot, cable: Cable, tell: Callable[[str], None]) -> None:
        self._world = twin.world
        self._robot = robot
        self._cable = cable
        self._tell = tell

    def descriptors(self) -> Sequence[int]:
        """What to wait for."""
        return self._cable.descriptors(self._robot.uart.room > 0)

    def events_ns(self) -> list[int]:
        """When the robot takes its next command and when its next byte arrives at the host [ns]."""
        times_ns = (self._robot.next_command_ns(), self._robot.uart.tx.next_ns)
        return [time_ns for time_ns in times_ns if time_ns is not None]

    def exchange(self, now: Callable[[], int] | None = None) -> None:
        """Takes what the host has sent, and gives it what has arrived for it.

        Args:
            now: gives simulated time by the clock on the wall, behind which the world may lag a little [ns].
        """
        robot, cable, uart = self._robot, self._cable, self._robot.uart
        answered = not len(uart.rx) and not len(uart.tx)
        received, time_ns = cable.receive(uart.room, answered), 0 if now is None else now()
        for notice in received.notices:
            self._note(notice)
        if received.last:
            robot.send(received.last, time_ns)
        if received.left:
            # What the host has sent still reaches the robot, as on a cable; nobody gets the answers.
            robot.hang_up()
            robot.compare_line(None)
        if received.data:
            if notice := robot.compare_line(cable.settings()):
                self._note(notice)
            robot.send(received.data, time_ns)
        self.give()

    def give(self) -> None:
        """Gives the host what has arrived for it."""
        reply = self._robot.uart.tx.read(self._world.time_ns)
        if reply and self._cable.occupied:
            self._cable.write(reply)

    def _note(self, text: str) -> None:
        self._world.tell(self._robot.index, text)
        self._tell(f"{self._cable.path}: {text}")
