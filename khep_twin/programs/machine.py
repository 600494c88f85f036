"""Computer of a robot of a world: transfers on its buses, its pins, and its time."""

import errno
from collections.abc import Sequence
from typing import Protocol, Self

from khep_twin.programs.computer import Computer, Devices
from khep_twin.robots.robot import Robot

READ_FLAG = 1
"""Flag of a read message."""


class MachineTime(Protocol):
    """Time of a machine, for example a `World`."""

    @property
    def time_ns(self) -> int:
        """Current time [ns]."""
        ...

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns], not before the present."""


class Machine:
    """The computer of a robot, as its programs see it.

    Args:
        computer: The computer of its model.
        devices: Its devices.
        clock: Its time.

    Attributes:
        computer: The computer of its model.
    """

    def __init__(self, computer: Computer, devices: Devices, clock: MachineTime) -> None:
        self.computer = computer
        self._devices = devices
        self._clock = clock
        self._levels = {**devices.levels}

    @classmethod
    def of(cls, robot: Robot, clock: MachineTime) -> Self:
        """Return the machine of a robot.

        Raises:
            RobotModelError: Its model has no computer.
        """
        computer = robot.robot_model.load("computer", Computer)
        return cls(computer, computer.connect(robot), clock)

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._clock.time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]; do nothing if it has passed."""
        if time_ns > self._clock.time_ns:
            self._clock.advance_to(time_ns)

    def transfer(self, bus: int, messages: Sequence[tuple[int, int, bytes]], byte_ns: int) -> bytes:
        """Run messages on a bus; return the content of the read messages.

        Args:
            bus: Number of the bus.
            messages: Address, flags and content of each; of a read message only the length counts.
            byte_ns: Simulated time of a byte [ns].

        Raises:
            OSError: No device has the address.
        """
        reply = b""
        for address, flags, content in messages:
            slave = self._devices.slaves.get((bus, address))
            if slave is None or not slave.is_powered:
                raise OSError(errno.ENXIO, "no device has answered")
            self.advance_to(self.time_ns + (len(content) + 1) * byte_ns)
            if flags & READ_FLAG and content:
                reply += slave.read(len(content))
            elif content:
                slave.write(content)
        return reply

    def set_pin(self, pin: int, level: int) -> None:
        """Set an output."""
        self._levels[pin] = int(bool(level))
        self._devices.on_pin(pin, self._levels[pin])

    def pin(self, pin: int) -> int:
        """Return the level of a pin, 0 for an unconnected pin (assumed)."""
        return self._levels.get(pin, 0)
