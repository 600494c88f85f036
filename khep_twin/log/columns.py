"""Columns of a log's channels in tables: names and units."""

import re
from collections.abc import Container

from khep_twin.board.kernel import Board, Wheel
from khep_twin.board.turrets import installed
from khep_twin.khepera4.channels import CHANNELS
from khep_twin.units import K213_PIXELS, SENSOR_LABELS

Columns = tuple[tuple[str, str], ...]
"""Name and unit of each column of a channel."""

_SIDES = ("left", "right")
_SENSORS = tuple(name.replace(" ", "_") for name in SENSOR_LABELS)
_SENSED = {
    kind: tuple((f"{kind}_{name}", "counts") for name in _SENSORS) for kind in ("proximity", "ambient")
}
_LATER = (Board.PROXIMITY, Board.AMBIENT, Board.SUPPLY, Board.CURRENT)
_REGISTERS = (
    *(f"{side}_{register.name.lower()}" for side in _SIDES for register in Wheel),
    *(register.name.lower() for register in Board if register not in _LATER),
    *(f"{kind}_{name}" for kind in ("proximity", "ambient") for name in _SENSORS),
    *("supply", "current"),
)
KNOWN: dict[str, Columns] = {
    "pose": (("x_m", "m"), ("y_m", "m"), ("heading_rad", "rad")),
    **_SENSED,
    "speed": tuple(
        (f"{what}_{side}", "pulses/10 ms") for what in ("speed", "speed_setpoint") for side in _SIDES
    ),
    "position": tuple((f"position_{side}", "pulses") for side in _SIDES),
    "duty": tuple((f"duty_{side}", "1/255") for side in _SIDES),
    "leds": (("led_lateral", "1 when lit"), ("led_frontal", "1 when lit")),
    "vision": tuple((f"vision_{pixel}", "grey") for pixel in range(K213_PIXELS)),
    "registers": tuple((f"register_{name}", "") for name in _REGISTERS),
}
"""Name and unit of each column by channel, in the order of the table: of a Khepera, ..."""


def _columns(name: str, label: str) -> Columns:
    """Return the columns of a channel by its label in a log."""
    names, _, unit = label.removesuffix("]").partition(" [")
    return tuple((f"{name}_{each.replace(' ', '_')}".lower(), unit) for each in names.split(", "))


KNOWN4: dict[str, Columns] = {name: _columns(name, label) for name, label in CHANNELS.items()}
KNOWN4["registers"] = tuple((f"register_{name}", "") for columns in KNOWN4.values() for name, _ in columns)
"""... and of a Khepera IV."""

KHEPERA4 = "khepera4_"
"""Begin of the names of a Khepera IV's channels and columns in a table with a Khepera's that are others."""

_LAST = ("lamps", "registers")


def columns_of(name: str, count: int, *, khepera4: bool = False) -> Columns:
    """Return the columns of a channel with so many numbers, of a Khepera IV or another robot."""
    turret, own = installed().get(name), KNOWN | (KNOWN4 if khepera4 else {})
    known = own.get(name, ()) if turret is None else tuple((f"{name}_{each}", "") for each in turret.names)
    if len(known) == count:
        return known
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{identifier(name)}_{index}", "") for index in range(count))


def is_khepera4(robot: str, topics: Container[str]) -> bool:
    """Return whether a robot is a Khepera IV, by the topics of its log."""
    return f"/{robot}/gyroscope" in topics


def named(name: str, count: int, *, khepera4: bool, mixed: bool) -> tuple[str, Columns]:
    """Return name and columns of a channel in a table, of robots of several models if `mixed`."""
    columns = columns_of(name, count, khepera4=khepera4)
    if khepera4 and mixed and name in {*KNOWN} & {*KNOWN4} and KNOWN[name] != KNOWN4[name]:
        return f"{KHEPERA4}{name}", tuple((f"{KHEPERA4}{column}", unit) for column, unit in columns)
    return name, columns


def in_order(names: set[str]) -> list[str]:
    """Return the names of channels in the order of a table."""
    known = [name for name in {**KNOWN, **KNOWN4} if name not in _LAST]
    order = [*known, *sorted(names - {*known, *_LAST}), *_LAST]
    return [name for name in order if name in names]


def identifier(name: str) -> str:
    """Return a name as a Matlab identifier."""
    words = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (words if words[:1].isalpha() else f"c{words}")[:20]
