"""One robot of a served twin and the host at the far end of its cable."""

from collections.abc import Callable, Sequence

from khep_twin.ports.host_port import HostPort
from khep_twin.ports.twin import Twin
from khep_twin.robot import Robot


class Connection:
    """Byte transfer between a robot's line and its cable, with a check of the host's line settings.

    Args:
        twin: Twin whose world the robot is in.
        robot: Robot at this end.
        port: Cable to the host.
        notify: Callback that takes notices for the user.
    """

    def __init__(self, twin: Twin, robot: Robot, port: HostPort, notify: Callable[[str], None]) -> None:
        self._world = twin.world
        self._robot = robot
        self._cable = port
        self._notify = notify

    def descriptors(self) -> Sequence[int]:
        """Return the descriptors to wait for."""
        return self._cable.descriptors(self._robot.uart.room > 0)

    def events_ns(self) -> list[int]:
        """Return the times of the robot's next command and of its next byte's arrival at the host [ns]."""
        times_ns = (self._robot.next_command_ns(), self._robot.uart.tx.next_ns)
        return [time_ns for time_ns in times_ns if time_ns is not None]

    def exchange(self, now: Callable[[], int] | None = None) -> None:
        """Pass the host's bytes to the robot, and the robot's that have arrived to the host.

        Args:
            now: Simulated time by the wall clock, which the world may lag behind a little [ns].
        """
        robot, port, uart = self._robot, self._cable, self._robot.uart
        answered = not len(uart.rx) and not len(uart.tx)
        received, time_ns = port.receive(uart.room, answered), 0 if now is None else now()
        for notice in received.notices:
            self._note(notice)
        if received.last:
            robot.send(received.last, time_ns)
        if received.left:
            # What the host has sent still reaches the robot, as on a cable; the answers are dropped.
            robot.disconnect()
            robot.compare_line(None)
        if received.data:
            if notice := robot.compare_line(port.settings()):
                self._note(notice)
            robot.send(received.data, time_ns)
        self.give()

    def give(self) -> None:
        """Pass the bytes that have arrived to the host."""
        reply = self._robot.uart.tx.read(self._world.time_ns)
        if reply and self._cable.occupied:
            self._cable.write(reply)

    def _note(self, text: str) -> None:
        self._world.log_event(self._robot.index, text)
        self._notify(f"{self._cable.path}: {text}")
