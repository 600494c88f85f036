"""The computer of a robot, as its programs see it: device nodes, buses, pins, files, memory and time.

`Computer` describes that of a model (`RobotModel.parts`, docs/robots.md); `Machine` is that of a robot.
"""

import errno
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol

from khep_twin.robots.robot import Robot
from khep_twin.world import World

PINS, PWM = 2 << 16, 3 << 16
"""Nodes of pins (`assets/include/user-gpio-drv.h` has their requests), and of PWM, which take any request."""

MEMORY_NODE, READ_FLAG = "/dev/mem", 1
"""Path of the memory; flag of a read message."""


def i2c_bus(number: int = 0, sends_empty: bool = False) -> int:
    """Return a node of an I2C bus, 0 to 127, whose adapter sends or refuses (EINVAL) messages of length 0."""
    return 1 << 16 | sends_empty << 15 | number << 8


class Slave(Protocol):
    """A device on an I2C bus."""

    @property
    def is_powered(self) -> bool:
        """True if it answers."""
        ...

    def write(self, message: bytes) -> None:
        """Execute a message of 1 byte or more."""

    def read(self, count: int) -> bytes:
        """Return the bytes of a message, 1 or more."""
        ...


class Devices(NamedTuple):
    """Devices of a robot.

    Attributes:
        slaves: Slaves by the number of their bus and their address.
        levels: Levels of pins at the start; those of others are 0 (assumed).
        on_pin: Function that is called when a program sets a pin, with its number and level, 0 or 1.
    """

    slaves: Mapping[tuple[int, int], Slave]
    levels: Mapping[int, int] = {}
    on_pin: Callable[[int, int], None] = lambda pin, level: None


class Computer(NamedTuple):
    """The computer of a model of robot.

    Attributes:
        nodes: Device nodes by path; `*` at the end of a path stands for any end.
        connect: Function that returns the devices of a robot of the model.
        files: Function of the robot's number, from 1, that returns texts of files by path. Programs see no
            other file in the folders of these files.
        byte_ns: Time of a byte on a bus [ns].
        memory: 32-bit words by physical address, below 2 GiB, in the node `MEMORY_NODE`. Others up to the
            end of the last page are 0.
    """

    nodes: Mapping[str, int]
    connect: Callable[..., Devices]
    files: Callable[[int], Mapping[str, str]]
    byte_ns: int
    memory: Mapping[int, int] = {}


class Machine:
    """The computer of a robot of a world.

    Args:
        robot: The robot.
        world: Its world, or another clock.

    Attributes:
        computer: The computer of its model.
    """

    def __init__(self, robot: Robot, world: World) -> None:
        self.computer = robot.robot_model.load("computer", Computer)
        self._devices = self.computer.connect(robot)
        self._levels = {**self._devices.levels}
        self._world = world

    @property
    def time_ns(self) -> int:
        """Simulated time [ns]."""
        return self._world.time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance to a time [ns]; do nothing if it has passed."""
        if time_ns > self._world.time_ns:
            self._world.advance_to(time_ns)

    def transfer(self, bus: int, messages: Sequence[tuple[int, int, bytes]], byte_ns: int) -> bytes:
        """Run messages on a bus; return the content of the read messages.

        A message has address, flags and content; of a read message only the length counts. A byte takes
        `byte_ns` [ns], and so does an address without an answer.

        Raises:
            OSError: No device has the address.
        """
        reply = b""
        for address, flags, content in messages:
            slave = self._devices.slaves.get((bus, address))
            if slave is None or not slave.is_powered:
                self.advance_to(self.time_ns + byte_ns)  # the address: a loop of such messages takes time
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
        """Return the level of a pin."""
        return self._levels.get(pin, 0)
