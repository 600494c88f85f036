"""Columns of a log's channels in tables: names and units."""

import re
from collections.abc import Collection

from khep_twin.board.turrets import installed_turrets
from khep_twin.robots.model import Columns, RobotModel
from khep_twin.robots.registry import default_model, installed_families

_LAST_CHANNELS = ("lamps", "registers")


def columns_of(name: str, count: int, model: RobotModel | None = None) -> Columns:
    """Return the `count` columns of a robot's channel by its name; unknown ones are numbered."""
    turret = installed_turrets().get(name)
    known_columns = {**default_model().channels, **(model.channels if model else {})}
    columns = known_columns.get(name, ())
    if turret is not None:
        columns = tuple((f"{name}_{register}", "") for register in turret.names)
    if len(columns) == count:
        return columns
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{to_identifier(name)}_{index}", "") for index in range(count))


def name_columns(name: str, count: int, model: RobotModel, families: Collection[str]) -> tuple[str, Columns]:
    """Return name and columns of a channel in a table of robots of some families.

    The family's name is a prefix there if an earlier family has a channel of this name with other columns:
    the default model, which may be absent, or one of `families`, in the order of the registry.
    """
    columns = columns_of(name, count, model)
    earlier = (default_model(), *(other for key, other in installed_families().items() if key in families))
    first_columns = next((other.channels[name] for other in earlier if name in other.channels), None)
    if len(families) > 1 and model.channels.get(name) not in (None, first_columns):
        prefix = f"{model.family}_"
        return f"{prefix}{name}", tuple((prefix + column, unit) for column, unit in columns)
    return name, columns


def order_channels(names: set[str]) -> list[str]:
    """Return the names of channels in the order of a table."""
    channel_names = dict.fromkeys(name for model in installed_families().values() for name in model.channels)
    known_names = [name for name in channel_names if name not in _LAST_CHANNELS]
    order = [*known_names, *sorted(names - {*known_names, *_LAST_CHANNELS}), *_LAST_CHANNELS]
    return [name for name in order if name in names]


def to_identifier(name: str) -> str:
    """Return a name as a Matlab identifier."""
    text = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (text if text[:1].isalpha() else f"c{text}")[:20]
