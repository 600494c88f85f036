"""Logs as tables for other programs: CSV for everyone, Parquet for data frames, MAT for Matlab.

    .csv      one table: time_s and a column for each value, a row for each time at which something was told
    .parquet  the same table, with unit and channel as metadata of each column
    .mat      a matrix for each channel with its own times: proximity, proximity_time_s, proximity_columns;
              transcript and events as cells

Where channels have times of their own, as in logs of real robots, a table's cells stay empty between them.
The same log gives the same bytes.
"""

# scipy and pyarrow are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import LogError, choices
from khep_twin.gripper import Register
from khep_twin.kernel import Board, Wheel
from khep_twin.lab.mat_bytes import mat_bytes
from khep_twin.lab.sensor_test import SENSORS
from khep_twin.log.channels import Line
from khep_twin.log.reader import Recording, Series

SUFFIXES = (".csv", ".parquet", ".mat")

_SIDES = ("left", "right")
_SENSORS = tuple(name.replace(" ", "_") for name in SENSORS)
_SENSED = {
    kind: tuple((f"{kind}_{name}", "counts") for name in _SENSORS) for kind in ("proximity", "ambient")
}
_REGISTERS = (
    *(f"{side}_{register.name.lower()}" for side in _SIDES for register in Wheel),
    *(
        register.name.lower()
        for register in Board
        if register not in (Board.PROXIMITY, Board.AMBIENT, Board.SUPPLY, Board.CURRENT)
    ),
    *(f"{kind}_{name}" for kind in ("proximity", "ambient") for name in _SENSORS),
    "supply",
    "current",
)
_KNOWN: dict[str, tuple[tuple[str, str], ...]] = {
    "pose": (("x_m", "m"), ("y_m", "m"), ("heading_rad", "rad")),
    **_SENSED,
    "speed": tuple(
        (f"{what}_{side}", "pulses/10 ms") for what in ("speed", "speed_setpoint") for side in _SIDES
    ),
    "position": tuple((f"position_{side}", "pulses") for side in _SIDES),
    "duty": tuple((f"duty_{side}", "1/255") for side in _SIDES),
    "leds": (("led_lateral", "1 when lit"), ("led_frontal", "1 when lit")),
    "gripper": tuple((f"gripper_{register.name.lower()}", "") for register in Register),
    "registers": tuple((f"register_{name}", "") for name in _REGISTERS),
}
"""Name and unit of each column by channel, in the order of the table."""

_LAST = ("lamps", "registers")
_UNASKED = ("registers",)
"""Exported only where it is chosen: most of it stands in other channels, too."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One channel of a robot, or the lamps.

    Attributes:
        name: e.g. "proximity".
        columns: their names and units.
        series: times (n,) [ns] and values (n, columns).
    """

    name: str
    columns: tuple[tuple[str, str], ...]
    series: Series


def checked_suffix(path: Path) -> str:
    """A file's suffix in small letters, if it is one of ours.

    Raises:
        LogError: it is not.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise LogError(f"{path}: right is a name that ends in .csv, .parquet or .mat")
    return path.suffix.lower()


def chosen_robot(recording: Recording, robot: str | None) -> str:
    """The robot of a name, the first one without.

    Raises:
        LogError: the log has no such robot.
    """
    names = recording.label.robots
    if robot is not None and robot not in names:
        raise LogError(f"--robot {robot}: not in this log; {choices(robot, names)}")
    return names[0] if robot is None else robot


def chosen_channels(recording: Recording, robot: str, names: Sequence[str] | None) -> list[Channel]:
    """What a log has of a robot, and of the lamps.

    Args:
        recording: the log.
        robot: its name.
        names: of the channels wanted, in their order; without, all but the registers.

    Raises:
        LogError: the log has no such channel.
    """
    found: dict[str, Channel] = {}
    for topic, series in recording.series.items():
        owner, _, name = topic.removeprefix("/").rpartition("/")
        if owner == robot or (not owner and name.startswith("lamps")):
            found[name] = Channel(name, _columns(name, series.values.shape[1]), series)
    order = [*(name for name in _KNOWN if name not in _LAST), *sorted({*found} - {*_KNOWN, *_LAST}), *_LAST]
    there = [name for name in order if name in found]
    if names is None:
        return [found[name] for name in there if name not in _UNASKED]
    for name in names:
        if name not in found:
            raise LogError(f"--channels {name}: {robot} has none in this log; {choices(name, there)}")
    return [found[name] for name in dict.fromkeys(names)]


def table(channels: Sequence[Channel], kind: str) -> bytes:
    """Channels of one robot as the bytes of a file, by its suffix ".csv" or ".parquet"."""
    times_ns = np.unique(np.concatenate([channel.series.times_ns for channel in channels]))
    return (_csv if kind == ".csv" else _parquet)(times_ns, channels)


def matrices(recording: Recording, robot: str, channels: Sequence[Channel]) -> bytes:
    """Channels, transcript and events as the bytes of a MAT file."""
    values: dict[str, Any] = {}
    for channel in channels:
        name = _identifier(channel.name)
        values[name] = channel.series.values.astype(np.float64)
        values[f"{name}_time_s"] = channel.series.times_ns.reshape(-1, 1) / 1e9
        values[f"{name}_columns"] = _cells([column for column, _ in channel.columns])
        values[f"{name}_units"] = _cells([unit for _, unit in channel.columns])
    for name, topic in (("serial", f"/{robot}/serial"), ("events", "/events")):
        lines = recording.lines.get(topic, [])
        values[f"{name}_time_s"] = np.array([line.time_ns / 1e9 for line in lines]).reshape(-1, 1)
        values[f"{name}_from"] = _cells([line.name for line in lines])
        values[f"{name}_text"] = _cells([line.text for line in lines])
    return mat_bytes(values, "log")


def transcript(lines: Sequence[Line]) -> bytes:
    """What was said on a serial line, as the bytes of a CSV file."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time_s", "from", "text"])
    writer.writerows([repr(line.time_ns / 1e9), line.name, line.text] for line in lines)
    return text.getvalue().encode("utf-8")


def _columns(name: str, count: int) -> tuple[tuple[str, str], ...]:
    """Names and units of a channel's columns."""
    known = _KNOWN.get(name, ())
    if len(known) == count:
        return known
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{_identifier(name)}_{index}", "") for index in range(count))


def _identifier(name: str) -> str:
    """A name as Matlab takes it."""
    words = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (words if words[:1].isalpha() else f"c{words}")[:20]


def _rows(times_ns: NDArray[np.int64], channel: Channel) -> NDArray[np.int64]:
    """For each time the channel's row (n,), -1 without; of several at one time the last."""
    rows = np.full(len(times_ns), -1)
    rows[np.searchsorted(times_ns, channel.series.times_ns)] = np.arange(len(channel.series.times_ns))
    return rows


def _whole(values: NDArray[Any]) -> NDArray[Any]:
    """Counts as whole numbers, as they are, though channels carry them as floats."""
    if not (np.isfinite(values).all() and np.array_equal(np.rint(values), values)):
        return values
    return values.astype(np.int64)


def _csv(times_ns: NDArray[np.int64], channels: Sequence[Channel]) -> bytes:
    columns: list[list[str]] = [[repr(time_ns / 1e9) for time_ns in times_ns.tolist()]]
    for channel in channels:
        rows = _rows(times_ns, channel).tolist()
        for values in _whole_or_not(channel).T:
            words = [*map(repr, values.tolist()), ""]  # the last is for the row -1
            columns.append([words[row] for row in rows])
    head = ",".join(["time_s", *(name for channel in channels for name, _ in channel.columns)])
    return "\n".join([head, *map(",".join, zip(*columns, strict=True)), ""]).encode("utf-8")


def _whole_or_not(channel: Channel) -> NDArray[Any]:
    """A channel's values; metres, radians and watts stay floats even where they happen to be whole."""
    values = channel.series.values
    return values if channel.name in ("pose", "lamps") else _whole(values)


def _parquet(times_ns: NDArray[np.int64], channels: Sequence[Channel]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    fields: list[Any] = [arrow.field("time_s", arrow.float64(), metadata={"unit": "s"})]
    columns: list[Any] = [arrow.array(times_ns / 1e9)]
    for channel in channels:
        rows = _rows(times_ns, channel)
        for (name, unit), values in zip(channel.columns, _whole_or_not(channel).T, strict=True):
            columns.append(arrow.array(values[rows], mask=rows < 0))
            metadata = {"unit": unit, "channel": channel.name}
            fields.append(arrow.field(name, columns[-1].type, metadata=metadata))
    file = BytesIO()
    whole: Any = arrow.Table.from_arrays(columns, schema=arrow.schema(fields))
    parquet.write_table(whole, file)
    return file.getvalue()


def _cells(texts: Sequence[str]) -> NDArray[np.object_]:
    """Texts as a column of cells."""
    cells = np.empty((len(texts), 1), object)
    cells[:, 0] = texts
    return cells
