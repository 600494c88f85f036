"""Columns of a log's channels in tables: names and units."""

import re
from collections.abc import Container

from khep_twin.board.kernel import Board, Wheel
from khep_twin.board.turrets import installed_turrets
from khep_twin.khepera4.channels import CHANNELS
from khep_twin.units import K213_PIXELS, SENSOR_LABELS

Columns = tuple[tuple[str, str], ...]
"""Name and unit of each column of a channel."""

_SIDES = ("left", "right")
_SENSORS = tuple(name.replace(" ", "_") for name in SENSOR_LABELS)
_SENSOR_COLUMNS = {
    kind: tuple((f"{kind}_{name}", "counts") for name in _SENSORS) for kind in ("proximity", "ambient")
}
_TRAILING_REGISTERS = (Board.PROXIMITY, Board.AMBIENT, Board.SUPPLY, Board.CURRENT)
_REGISTERS = (
    *(f"{side}_{register.name.lower()}" for side in _SIDES for register in Wheel),
    *(register.name.lower() for register in Board if register not in _TRAILING_REGISTERS),
    *(f"{kind}_{name}" for kind in ("proximity", "ambient") for name in _SENSORS),
    *("supply", "current"),
)
KHEPERA_COLUMNS: dict[str, Columns] = {
    "pose": (("x_m", "m"), ("y_m", "m"), ("heading_rad", "rad")),
    **_SENSOR_COLUMNS,
    "speed": tuple(
        (f"{quantity}_{side}", "pulses/10 ms") for quantity in ("speed", "speed_setpoint") for side in _SIDES
    ),
    "position": tuple((f"position_{side}", "pulses") for side in _SIDES),
    "duty": tuple((f"duty_{side}", "1/255") for side in _SIDES),
    "leds": (("led_lateral", "1 when lit"), ("led_frontal", "1 when lit")),
    "vision": tuple((f"vision_{pixel}", "grey") for pixel in range(K213_PIXELS)),
    "registers": tuple((f"register_{name}", "") for name in _REGISTERS),
}
"""Name and unit of each column by channel of a Khepera, in the order of the table."""


def _parse_columns(name: str, label: str) -> Columns:
    """Parse the label of a channel in a log to its columns."""
    names, _, unit = label.removesuffix("]").partition(" [")
    return tuple((f"{name}_{column.replace(' ', '_')}".lower(), unit) for column in names.split(", "))


KHEPERA4_COLUMNS: dict[str, Columns] = {name: _parse_columns(name, label) for name, label in CHANNELS.items()}
KHEPERA4_COLUMNS["registers"] = tuple(
    (f"register_{name}", "") for columns in KHEPERA4_COLUMNS.values() for name, _ in columns
)
"""Name and unit of each column by channel of a Khepera IV."""

KHEPERA4_PREFIX = "khepera4_"
"""Prefix of a Khepera IV's channels and columns in a table with a Khepera's different ones."""

_LAST_CHANNELS = ("lamps", "registers")


def columns_of(name: str, count: int, *, khepera4: bool = False) -> Columns:
    """Return the `count` columns of a robot's channel by its name; unknown ones are numbered."""
    turret = installed_turrets().get(name)
    known_columns = KHEPERA_COLUMNS | (KHEPERA4_COLUMNS if khepera4 else {})
    columns = known_columns.get(name, ())
    if turret is not None:
        columns = tuple((f"{name}_{register}", "") for register in turret.names)
    if len(columns) == count:
        return columns
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{to_identifier(name)}_{index}", "") for index in range(count))


def is_khepera4(robot: str, topics: Container[str]) -> bool:
    """Return whether a robot is a Khepera IV, by the topics of its log."""
    return f"/{robot}/gyroscope" in topics


def name_columns(name: str, count: int, *, khepera4: bool, is_mixed: bool) -> tuple[str, Columns]:
    """Return name and columns of a channel in a table; `is_mixed` if its robots are of several models."""
    columns = columns_of(name, count, khepera4=khepera4)
    khepera_columns, khepera4_columns = KHEPERA_COLUMNS.get(name), KHEPERA4_COLUMNS.get(name)
    if khepera4 and is_mixed and khepera_columns and khepera4_columns not in (None, khepera_columns):
        return f"{KHEPERA4_PREFIX}{name}", tuple((KHEPERA4_PREFIX + column, unit) for column, unit in columns)
    return name, columns


def order_channels(names: set[str]) -> list[str]:
    """Return the names of channels in the order of a table."""
    known_names = [name for name in {**KHEPERA_COLUMNS, **KHEPERA4_COLUMNS} if name not in _LAST_CHANNELS]
    order = [*known_names, *sorted(names - {*known_names, *_LAST_CHANNELS}), *_LAST_CHANNELS]
    return [name for name in order if name in names]


def to_identifier(name: str) -> str:
    """Return a name as a Matlab identifier."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (text if text[:1].isalpha() else f"c{text}")[:20]
