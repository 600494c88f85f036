"""The computer of a robot, as its programs see it: device nodes, buses, pins, files and memory.

The part `computer` of `RobotModel.parts` is a `Computer`. That of a robot with a sensor on its only bus:

    COMPUTER = Computer(
        nodes={"/dev/i2c-0": Node(Kind.I2C, bus=0), "/dev/i2c/0": Node(Kind.I2C, bus=0)},
        connect=lambda robot: Devices({(0, 0x31): Sensor(robot)}),
        files=lambda number: {"/etc/robot/number": str(number)},
        byte_ns=90_000,
        memory={0x40E00004: 1 << 8},
    )

`Sensor` is a `Slave`. `Machine.of(robot, clock)` is the computer of a robot of a world, for `run_programs`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

MEMORY_PATH = "/dev/mem"
"""Node of the memory."""

PAGE = 4096
"""Size of a page of the memory [bytes]."""


class Kind(IntEnum):
    """Kind of a device node, by its number in the preload library."""

    I2C = 1
    GPIO = 2  # pins, by the requests of `assets/include/user-gpio-drv.h`
    PWM = 3  # which accepts any request


class Node(NamedTuple):
    """A device node.

    Attributes:
        kind: Kind.
        bus: Number of its I2C bus, 0 to 127.
        sends_empty: Whether the adapter of the bus sends messages of length 0, by which programs look for
            slaves; otherwise it refuses them (EINVAL).
    """

    kind: Kind
    bus: int = 0
    sends_empty: bool = False


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
        slaves: Slaves by number of the bus and address.
        levels: Levels of the pins at the start; those of other pins are 0.
        on_pin: Function that is called when a program sets a pin, with its number and level, 0 or 1.
    """

    slaves: Mapping[tuple[int, int], Slave]
    levels: Mapping[int, int] = {}
    on_pin: Callable[[int, int], None] = lambda pin, level: None


@dataclass(frozen=True, slots=True)
class Computer:
    """The computer of a model of robot.

    Attributes:
        nodes: Nodes by their paths; `*` at the end of a path stands for any end.
        connect: Function that returns the devices of a robot of the model.
        files: Function that returns texts of files by path, for the robot's number, from 1. Programs see no
            other file in the folders of these files.
        byte_ns: Time of a byte on a bus [ns].
        memory: 32-bit words by their physical addresses, below 2 GiB. Each names its page of the node
            `MEMORY_PATH`; other words are 0. Without words there is no such node.
    """

    nodes: Mapping[str, Node]
    connect: Callable[[Any], Devices]
    files: Callable[[int], Mapping[str, str]] = lambda number: {}
    byte_ns: int = 90_000
    memory: Mapping[int, int] = field(default_factory=dict[int, int])

    @property
    def node_starts(self) -> list[bytes]:
        """Starts of the paths of all nodes."""
        return [path.rstrip("*").encode() for path in (*self.nodes, *([MEMORY_PATH] if self.memory else []))]

    @property
    def node_table(self) -> str:
        """Nodes for the preload library: number and path of each, separated by colons."""
        return ":".join(
            f"{node.kind << 16 | node.sends_empty << 15 | node.bus << 8}{path}"
            for path, node in self.nodes.items()
        )
