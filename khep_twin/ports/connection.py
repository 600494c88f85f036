"""Connection of one robot of a served twin to its host."""

from collections.abc import Callable, Sequence

from khep_twin.clock import NEVER_NS
from khep_twin.ports.host_port import NOTHING, HostPort
from khep_twin.ports.twin import Twin
from khep_twin.robots.robot import Robot


class Connection:
    """Byte transfer between a robot's line and its host port, with a check of the host's line settings."""

    def __init__(self, twin: Twin, robot: Robot, port: HostPort, notify: Callable[[str], None]) -> None:
        self._world = twin.world
        self._robot = robot
        self._port = port
        self._notify = notify
        self._baud = 0

    @property
    def has_room(self) -> bool:
        """True if the robot's line accepts more bytes of the host."""
        uart = self._robot.uart
        return uart.rx.next_ns is None or uart.free_capacity > 0

    def descriptors(self) -> Sequence[int]:
        """Return the descriptors to wait for."""
        return self._port.descriptors(self.has_room)

    def next_ns(self) -> int:
        """Return the time of the robot's next command, or of its next byte's arrival at the host [ns]."""
        uart = self._robot.uart
        byte_ns = uart.tx.next_ns
        if uart.rx.next_ns is None:
            return NEVER_NS if byte_ns is None else byte_ns
        command_ns = self._command_ns()
        return command_ns if byte_ns is None else min(byte_ns, command_ns)

    def next_stop_ns(self) -> int:
        """Return the time of the robot's next command; without one, of the arrival of its last byte [ns].

        Without both, a line filled by an unfinished command must regain room: the arrival of its last byte.
        """
        if (command_ns := self._command_ns()) != NEVER_NS:
            return command_ns
        rx, tx = self._robot.uart.rx, self._robot.uart.tx
        last_ns = tx.arrival_ns(len(tx))
        if last_ns is None and not self.has_room:
            last_ns = rx.arrival_ns(len(rx))
        return NEVER_NS if last_ns is None else last_ns

    def receive(self, clock: Callable[[], int] | None = None) -> int:
        """Pass the host's bytes to the robot; return the time at which they were sent, 0 without any [ns].

        `clock` returns the simulated time by the wall clock, which may be slightly ahead of the world [ns].
        """
        robot, port, uart = self._robot, self._port, self._robot.uart
        # An unfinished line gets no reply, even with bytes in transit: the wire clock stands still.
        is_answered = uart.tx.next_ns is None and self._command_ns() == NEVER_NS
        if self._baud != robot.firmware.baud:
            self._baud = robot.firmware.baud
            port.set_baud(self._baud)
        received = port.receive(uart.free_capacity, is_answered)
        if received is NOTHING:
            return 0
        time_ns = 0 if clock is None else clock()
        for notice in received.notices:
            self._report(notice)
        if received.last_data:
            robot.send(received.last_data, time_ns)
        if received.hosts_left:
            # Bytes that the host has sent still reach the robot, as on a cable; the replies are dropped.
            robot.disconnect()
            robot.set_host_line(None)
        if received.data:
            if notice := robot.set_host_line(port.settings()):
                self._report(notice)
            robot.send(received.data, time_ns)
        return time_ns

    def deliver(self) -> None:
        """Pass the bytes that have arrived to the host."""
        self._deliver(self._world.time_ns)

    def deliver_early(self, time_ns: int) -> None:
        """Pass the bytes that arrive by `time_ns` to the host, before the world has reached that time.

        The line keeps its bytes while commands wait for room on it.
        """
        if self._robot.uart.rx.next_ns is None:
            self._deliver(time_ns)

    def _deliver(self, time_ns: int) -> None:
        tx = self._robot.uart.tx
        if tx.next_ns is not None and tx.next_ns <= time_ns:
            reply = tx.read(time_ns)
            if self._port.occupied:
                self._port.write(reply, not len(tx))

    def _command_ns(self) -> int:
        """Return the time of the robot's next command [ns]."""
        robot = self._robot
        command_ns = None if robot.uart.rx.next_ns is None else robot.next_command_ns()
        return NEVER_NS if command_ns is None else command_ns

    def _report(self, notice: str) -> None:
        self._world.log_event(self._robot.index, notice)
        self._notify(f"{self._port.path}: {notice}")
