"""Columns of a log's channels in tables: names and units."""

import re

from khep_twin.board.kernel import Board, Wheel
from khep_twin.board.turrets import installed
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
"""Name and unit of each column by channel, in the order of the table."""

_LAST = ("lamps", "registers")


def columns_of(name: str, count: int) -> Columns:
    """Return the columns of a channel with so many numbers."""
    turret = installed().get(name)
    known = KNOWN.get(name, ()) if turret is None else tuple((f"{name}_{each}", "") for each in turret.names)
    if len(known) == count:
        return known
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{identifier(name)}_{index}", "") for index in range(count))


def in_order(names: set[str]) -> list[str]:
    """Return the names of channels in the order of a table."""
    order = [*(name for name in KNOWN if name not in _LAST), *sorted(names - {*KNOWN, *_LAST}), *_LAST]
    return [name for name in order if name in names]


def identifier(name: str) -> str:
    """Return a name as a Matlab identifier."""
    words = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (words if words[:1].isalpha() else f"c{words}")[:20]
