"""Turrets: boards on top of the robot that answer on its T bus.

A turret has electronics, which receive orders and hold registers. It may have a body in the physics, which
writes sensor readings into those registers and is driven from them. A package registers a `TurretKind` under
the entry point "khep_twin.turrets", as khep_twin does for the gripper:

    [project.entry-points."khep_twin.turrets"]
    gripper = "khep_twin.board.gripper_body:GRIPPER"

Several turrets form a stack from the robot upwards, in the order in which they are named. The MJCF file of a
turret has it directly on the robot; the heights of the turrets below are added to its position.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Protocol

from khep_twin.board.terms import Term
from khep_twin.errors import TurretError, choices
from khep_twin.files.paths import StrPath
from khep_twin.lazy import load_plugins

if TYPE_CHECKING:
    import mujoco
    import numpy as np
    from numpy.typing import NDArray

GROUP = "khep_twin.turrets"
"""Entry point under which packages register their turrets."""

NUMBERS = range(32)
"""Numbers of turrets on the T bus: 0 to 23 are K-Team's, 24 to 31 the users' (public host programs)."""


class Turret(Protocol):
    """Electronics of a turret, which map received bytes to replies, without clock, file or thread."""

    registers: "NDArray[np.int64]"
    """Whole state, shared with the body (n,)."""

    def receive(self, message: bytes) -> bytes:
        """Return the reply line to a message on the T bus, from `protocol.turret_reply` or `refusal`."""
        ...

    def tick(self) -> None:
        """Run one control period of 10 ms."""

    def reset(self) -> None:
        """Set the registers to their reset values."""


class TurretContext(Protocol):
    """Interface of the world to the body of a turret."""

    model: "mujoco.MjModel"
    """Model of the scene."""

    data: "mujoco.MjData"
    """State of the scene."""

    prefix: str
    """Prefix of the turret's names in the scene, e.g. "khepera0/gripper/"."""

    registers: "NDArray[np.int64]"
    """Registers of the turret's electronics (n,)."""

    robot: int
    """Index of the robot that carries it."""

    @property
    def time_ns(self) -> int:
        """Time of the world [ns]."""
        ...

    @property
    def lamps(self) -> Sequence[tuple[float, float, float, float]]:
        """Positions [m] and present power [W] of the lamps: x, y, z, power."""
        ...

    @property
    def room_lux(self) -> float:
        """Illuminance by the ambient light of the room [lx]."""
        ...

    @property
    def key(self) -> tuple[int, int]:
        """Key of the turret's random draws for `sensing.noise`, derived from the world's seed."""
        ...

    @property
    def noise(self) -> float:
        """Scale of the sensors' noise; 0 without noise."""
        ...

    @property
    def settings(self) -> Mapping[str, float]:
        """Values of the playpen's table for turrets of this kind; empty without one."""
        ...

    @property
    def is_compiled(self) -> bool:
        """True if the world is stepped by compiled code; a body may then also use compiled code."""
        ...

    @property
    def peers(self) -> "Sequence[TurretBody | None]":
        """Bodies of the turrets of this kind by the index of their robot; None for a robot without one."""
        ...


class TurretBody(Protocol):
    """Body of a turret in the world."""

    def sense(self) -> None:
        """Store the readings of the turret's converters in the registers; before each control period."""

    def drive(self) -> None:
        """Drive the turret's motors from the registers; after each control period."""


@dataclass(frozen=True, slots=True)
class TurretKind:
    """One kind of turret.

    Attributes:
        name: Name in playpen files.
        number: Number on the T bus.
        description: A few words for the tool `net`.
        revision: Revision of the turret's ROM.
        make: Factory of its electronics.
        scene: MJCF file, with its origin on the floor under the robot's centre; None without a body. Its
            keyframe "home" has the motors' initial targets.
        fit: Factory of its body from its context; None without a body.
        reach: Radius around the robot's centre that it covers at the start [m].
        names: Names of its registers, for tables; empty for numbers.
        image: Registers of a line image, from left to right, greys of 0 to 255; None without.
        ranges: Smallest and largest value of each register that a snapshot may hold; any value of 64 bits for
            registers without a range.
        height: Height by which it raises turrets on top of it [m]; None if no turret fits there.
        is_lowest: True if it fits only directly on the robot, such as an arm that reaches the floor.
        terms: Registers that controllers of episodes may read and set, by names that start with its name.
    """

    name: str
    number: int
    description: str
    revision: str
    make: Callable[[], Turret]
    scene: StrPath | None = None
    fit: Callable[[TurretContext], TurretBody] | None = None
    reach: float = 0.0
    names: tuple[str, ...] = ()
    image: slice | None = field(default=None, hash=False)
    ranges: Mapping[int, tuple[int, int]] = field(default_factory=dict[int, tuple[int, int]], hash=False)
    height: float | None = 0.0
    is_lowest: bool = False
    terms: tuple[Term, ...] = field(default=(), hash=False)


@cache
def installed_turrets() -> Mapping[str, TurretKind]:
    """Return the turrets of all installed packages by name, in an order in which they stack.

    Raises:
        TurretError: A package registers an object that is no turret, or a name that is in use.
    """
    kinds = load_plugins(
        sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)),
        TurretKind,
        TurretError,
        "turret",
        is_valid=lambda kind: kind.number in NUMBERS,
        expected=" with a number from 0 to 31",
    )
    return dict(sorted(kinds.items(), key=lambda item: (not item[1].is_lowest, item[1].height is None)))


def find_turrets(names: Sequence[str]) -> tuple[TurretKind, ...]:
    """Return the turrets of these names, stacked in this order from the robot upwards.

    Raises:
        TurretError: A name is unknown, two turrets have the same number on the bus, or one does not fit on
            the turrets below it.
    """
    known_kinds = installed_turrets()
    by_number: dict[int, TurretKind] = {}
    for name in names:
        if name not in known_kinds:
            raise TurretError(f"unknown turret {name!r}; {choices(name, known_kinds)}")
        kind = known_kinds[name]
        if by_number.get(kind.number) is kind:
            raise TurretError(f"turret {name!r} is named twice")
        if other_kind := by_number.get(kind.number):
            raise TurretError(f"turret {name!r} and {other_kind.name!r} are both number {kind.number}")
        by_number[kind.number] = kind
    kinds = tuple(by_number.values())
    mount_heights(kinds)
    return kinds


def mount_heights(kinds: Sequence[TurretKind]) -> tuple[float, ...]:
    """Return the mount height of each turret of a stack, the sum of the heights below it [m].

    A turret with neither body nor height takes no place in the stack.

    Raises:
        TurretError: A turret does not fit on the turrets below it.
    """
    heights: list[float] = []
    height, top_kind = 0.0, None
    for kind in kinds:
        if top_kind is not None and (kind.scene is not None or kind.height != 0):
            raise TurretError(
                f"nothing fits on turret {top_kind.name!r}; expected it last, not below {kind.name!r}"
            )
        if kind.is_lowest and height > 0:
            raise TurretError(f"turret {kind.name!r} fits only right on the robot; expected it first")
        heights.append(height)
        if kind.height is None:
            top_kind = kind
        height += kind.height or 0.0
    return tuple(heights)
