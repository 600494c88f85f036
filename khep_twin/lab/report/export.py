"""Export of logs as tables: CSV, Parquet for data frames, and MAT for Matlab.

    .csv      one table: time_s and a column for each value, a row for each time of a message
    .parquet  the same table, with unit and channel as metadata of each column
    .mat      a matrix for each channel with its own times: proximity, proximity_time_s, proximity_columns;
              transcript and events as cells

If channels have their own times, as in logs of real robots, a table's cells stay empty between them.
The same log gives the same bytes.
"""

# scipy and pyarrow are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import csv
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import Board, Wheel
from khep_twin.board.turrets import installed
from khep_twin.errors import LogError, choices
from khep_twin.files.mat_file import mat_bytes
from khep_twin.log.channels import TextLine
from khep_twin.log.reader import Recording, TimeSeries, read_pieces
from khep_twin.units import K213_PIXELS, SENSOR_LABELS

MAT_BYTES = 512 << 20
"""Largest size of numbers and text in a MAT file [bytes]; it is built in memory, in several times as much."""

LINE_BYTES = 100
"""Assumed size of a line of the transcript [bytes]."""

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
_KNOWN: dict[str, tuple[tuple[str, str], ...]] = {
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


@dataclass(frozen=True, slots=True)
class Channel:
    """Channel of a robot, or the lamps.

    Attributes:
        name: Name, e.g. "proximity".
        topic: Topic in the log, e.g. "/khepera0/proximity".
        columns: Names and units of the columns.
        series: Times (n,) [ns] and values (n, columns).
    """

    name: str
    topic: str
    columns: tuple[tuple[str, str], ...]
    series: TimeSeries


def checked_suffix(path: Path) -> str:
    """Return a file's suffix in lower case.

    Raises:
        LogError: The suffix is not in `SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        *others, last = SUFFIXES
        raise LogError(f"{path}; expected a name that ends in {', '.join(others)} or {last}")
    return path.suffix.lower()


def chosen_robot(recording: Recording, robot: str | None) -> str:
    """Return the name of the chosen robot, by default the first one.

    Raises:
        LogError: The log has no such robot.
    """
    names = recording.label.robots
    if robot is not None and robot not in names:
        raise LogError(f"--robot {robot}: not in this log; {choices(robot, names)}")
    return names[0] if robot is None else robot


def chosen_channels(recording: Recording, robot: str, names: Sequence[str] | None) -> list[Channel]:
    """Return channels of a robot and of the lamps.

    Args:
        recording: Recording of the log.
        robot: Name of the robot.
        names: Names of the channels, in their order; by default all but the registers of the board and of
            turrets with line images, most of which are in other channels, too.

    Raises:
        LogError: The log has no such channel.
    """
    found: dict[str, Channel] = {}
    for topic, series in recording.series.items():
        owner, _, name = topic.removeprefix("/").rpartition("/")
        if owner == robot or (not owner and name.startswith("lamps")):
            found[name] = Channel(name, topic, _columns(name, series.values.shape[1]), series)
    order = [*(name for name in _KNOWN if name not in _LAST), *sorted({*found} - {*_KNOWN, *_LAST}), *_LAST]
    there = [name for name in order if name in found]
    if names is None:
        unasked = {"registers", *(kind.name for kind in installed().values() if kind.image)}
        return [found[name] for name in there if name not in unasked]
    for name in names:
        if name not in found:
            raise LogError(f"--channels {name}: {robot} has none in this log; {choices(name, there)}")
    return [found[name] for name in dict.fromkeys(names)]


def write_table(
    log: Path,
    channels: Sequence[Channel],
    kind: str,
    file: BinaryIO,
    progress: Callable[[float], None] | None = None,
) -> int:
    """Write channels of one robot as a table, piece by piece; return the number of its rows.

    Args:
        log: Path of the log.
        channels: Columns of the table, as `chosen_channels` found them; their series are not used.
        kind: Suffix, one of `TABLES`.
        file: File that is written, open for reading, too.
        progress: Called with the completed part, 0 to 1.

    Raises:
        LogError: The log is not whole.
    """
    # Counts are whole numbers, though messages carry them as floats, until one is found that is not.
    fractional = {channel.name for channel in channels} & {"pose", "lamps"}
    while True:
        file.seek(0)
        file.truncate()
        writer = TABLES[kind](file, channels, fractional)
        n_rows, found = 0, set[str]()
        with closing(writer):
            for piece in read_pieces(log, progress):
                parts = [_part(log, channel, piece) for channel in channels]
                found = {each.name for each in parts if each.name not in fractional and not _is_whole(each)}
                if found:
                    break
                times_ns = np.unique(np.concatenate([part.series.times_ns for part in parts]))
                writer.write(times_ns, parts)
                n_rows += len(times_ns)
        if not found:
            return n_rows
        fractional |= found


def matrices(
    log: Path, robot: str, channels: Sequence[Channel], progress: Callable[[float], None] | None = None
) -> tuple[bytes, int]:
    """Return channels, transcript and events as the bytes of a MAT file, and the number of distinct times.

    Raises:
        LogError: The log is not whole, or has more than a MAT file should.
    """
    parts: list[list[TimeSeries]] = [[] for _ in channels]
    lines: dict[str, list[TextLine]] = {f"/{robot}/serial": [], "/events": []}
    size = 0
    for piece in read_pieces(log, progress):
        for channel, found in zip(channels, parts, strict=True):
            found.append(_part(log, channel, piece).series)
            size += found[-1].values.size * 8
        for topic, told in lines.items():
            told += piece.lines.get(topic, [])
            size += len(piece.lines.get(topic, ())) * LINE_BYTES
        if size > MAT_BYTES:
            raise LogError(
                f"{log}: more than {MAT_BYTES >> 20} MiB of numbers and text, which is made in memory for a "
                "MAT file; expected a shorter log, fewer --channels, or -o FILE.csv or .parquet"
            )
    values: dict[str, object] = {}
    for channel, found in zip(channels, parts, strict=True):
        name = _identifier(channel.name)
        values[name] = np.concatenate([each.values for each in found]).astype(np.float64)
        values[f"{name}_time_s"] = np.concatenate([each.times_ns for each in found]).reshape(-1, 1) / 1e9
        values[f"{name}_columns"] = _cells([column for column, _ in channel.columns])
        values[f"{name}_units"] = _cells([unit for _, unit in channel.columns])
    for name, told in zip(("serial", "events"), lines.values(), strict=True):
        values[f"{name}_time_s"] = np.array([line.time_ns / 1e9 for line in told]).reshape(-1, 1)
        values[f"{name}_from"] = _cells([line.name for line in told])
        values[f"{name}_text"] = _cells([line.text for line in told])
    times_ns = [each.times_ns for found in parts for each in found]
    return mat_bytes(values, "log"), len(np.unique(np.concatenate(times_ns))) if times_ns else 0


def write_transcript(
    log: Path, robot: str, file: BinaryIO, progress: Callable[[float], None] | None = None
) -> int:
    """Write the transcript of a robot's line as a CSV file, piece by piece; return the number of lines.

    Raises:
        LogError: The log is not whole.
    """
    n_lines = 0
    file.write(b"time_s,from,text\n")
    for piece in read_pieces(log, progress):
        text = StringIO()
        lines = piece.lines.get(f"/{robot}/serial", [])
        rows = ([repr(line.time_ns / 1e9), line.name, line.text] for line in lines)
        csv.writer(text, lineterminator="\n").writerows(rows)
        file.write(text.getvalue().encode("utf-8"))
        n_lines += len(lines)
    return n_lines


def _columns(name: str, count: int) -> tuple[tuple[str, str], ...]:
    """Return the names and units of a channel's columns."""
    turret = installed().get(name)
    known = _KNOWN.get(name, ()) if turret is None else tuple((f"{name}_{each}", "") for each in turret.names)
    if len(known) == count:
        return known
    if name == "lamps":
        return tuple((f"lamp_{index}_w", "W") for index in range(count))
    return tuple((f"{_identifier(name)}_{index}", "") for index in range(count))


def _identifier(name: str) -> str:
    """Return a name as a Matlab identifier."""
    words = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return (words if words[:1].isalpha() else f"c{words}")[:20]


def _rows(times_ns: NDArray[np.int64], channel: Channel) -> NDArray[np.int64]:
    """Return the channel's row for each time (n,), -1 without; of several at one time the last."""
    rows = np.full(len(times_ns), -1)
    rows[np.searchsorted(times_ns, channel.series.times_ns)] = np.arange(len(channel.series.times_ns))
    return rows


def _part(log: Path, channel: Channel, piece: Recording) -> Channel:
    """Return a channel with its series in a piece of the log, whose rows must be as long as at its begin."""
    series = piece.series.get(channel.topic, TimeSeries(np.zeros(0, np.int64), channel.series.values[:0]))
    if series.values.shape[1:] != channel.series.values.shape[1:]:
        raise LogError(
            f"{log}: {channel.topic} has {series.values.shape[1]} values at {series.times_ns[0] / 1e9} s, "
            f"expected {len(channel.columns)} as at its begin"
        )
    return replace(channel, series=series)


def _is_whole(channel: Channel) -> bool:
    """Return whether all values are integers."""
    values = channel.series.values
    return bool(np.isfinite(values).all() and np.array_equal(np.rint(values), values))


class _Csv:
    """CSV file that is written piece by piece; all but the `fractional` channels are integers."""

    def __init__(self, file: BinaryIO, channels: Sequence[Channel], fractional: Collection[str]) -> None:
        self._file, self._fractional = file, fractional
        head = ",".join(["time_s", *(name for channel in channels for name, _ in channel.columns)])
        file.write(f"{head}\n".encode())

    def write(self, times_ns: NDArray[np.int64], channels: Sequence[Channel]) -> None:
        """Write a row for each time with the values of the channels."""
        columns: list[list[str]] = [[repr(time_ns / 1e9) for time_ns in times_ns.tolist()]]
        for channel in channels:
            rows = _rows(times_ns, channel).tolist()
            for values in _numbers(channel, self._fractional).T:
                words = [*map(repr, values.tolist()), ""]  # the last is for the row -1
                columns.append([words[row] for row in rows])
        self._file.write("".join(f"{','.join(row)}\n" for row in zip(*columns, strict=True)).encode())

    def close(self) -> None:
        """End the file."""


class _Parquet:
    """Parquet file that is written piece by piece, each a row group; arguments as for `_Csv`."""

    def __init__(self, file: BinaryIO, channels: Sequence[Channel], fractional: Collection[str]) -> None:
        import pyarrow as arrow
        from pyarrow import parquet

        self._fractional = fractional
        fields = [arrow.field("time_s", arrow.float64(), metadata={"unit": "s"})]
        for channel in channels:
            kind = arrow.float64() if channel.name in fractional else arrow.int64()
            for name, unit in channel.columns:
                fields.append(arrow.field(name, kind, metadata={"unit": unit, "channel": channel.name}))
        self._schema = arrow.schema(fields)
        self._writer = parquet.ParquetWriter(file, self._schema)

    def write(self, times_ns: NDArray[np.int64], channels: Sequence[Channel]) -> None:
        """Write a row for each time with the values of the channels."""
        import pyarrow as arrow

        columns = [arrow.array(times_ns / 1e9)]
        for channel in channels:
            rows = _rows(times_ns, channel)
            for values in _numbers(channel, self._fractional).T:
                # The last is for the row -1, which is no value.
                columns.append(arrow.array(np.append(values, 0)[rows], mask=rows < 0))
        self._writer.write_table(arrow.Table.from_arrays(columns, schema=self._schema))

    def close(self) -> None:
        """End the file."""
        self._writer.close()


TABLES: Mapping[str, type[_Csv] | type[_Parquet]] = {".csv": _Csv, ".parquet": _Parquet}
"""Class of each kind of table by its suffix; a new kind is a class such as `_Csv`, and a line here."""

SUFFIXES = (*TABLES, ".mat")
"""Suffixes of all exports."""


def _numbers(channel: Channel, fractional: Collection[str]) -> NDArray[np.generic]:
    """Return a channel's values, as integers unless it is fractional."""
    values = channel.series.values
    return values if channel.name in fractional else values.astype(np.int64)


def _cells(texts: Sequence[str]) -> NDArray[np.object_]:
    """Return texts as a column of cells."""
    cells = np.empty((len(texts), 1), object)
    cells[:, 0] = texts
    return cells
