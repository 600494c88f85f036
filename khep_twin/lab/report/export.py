"""Export of logs as tables: CSV, Parquet for data frames, and MAT for Matlab.

    .csv      one table: time_s and a column for each value, a row for each time of a message
    .parquet  the same table, with unit and channel as metadata of each column
    .mat      a matrix for each channel with its own times: proximity, proximity_time_s, proximity_columns;
              transcript and events as cells

A table of several robots has their names in the column `robot`, and a row for each robot and time; a MAT file
has the robots of the rows of `proximity`, numbered from 1, in proximity_robot. Channels of a Khepera IV that
are others than a Khepera's begin with khepera4_ in a table of both. Cells stay empty between the
times of a channel, which are its own in logs of real robots, and where a robot has no such channel.
The same log gives the same bytes.
"""

# scipy and pyarrow are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import csv
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.turrets import installed
from khep_twin.errors import LogError, choices
from khep_twin.files.mat_file import mat_bytes
from khep_twin.lab.report.table_files import TABLES, Channel, Heading, is_whole, rows_of
from khep_twin.log.channels import TextLine
from khep_twin.log.columns import KHEPERA4, Columns, identifier, in_order, is_khepera4, named
from khep_twin.log.reader import Recording, TimeSeries, read_pieces

MAT_BYTES = 512 << 20
"""Largest size of numbers and text in a MAT file [bytes]; it is built in memory, in several times as much."""

LINE_BYTES = 100
"""Assumed size of a line of the transcript [bytes]."""

_NAMED = 5
"""Most robots that are named one by one."""


def checked_suffix(path: Path) -> str:
    """Return a file's suffix in lower case.

    Raises:
        LogError: The suffix is not in `SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        *others, last = SUFFIXES
        raise LogError(f"{path}; expected a name that ends in {', '.join(others)} or {last}")
    return path.suffix.lower()


def chosen_robots(recording: Recording, robot: str | None) -> tuple[str, ...]:
    """Return the name of the chosen robot, by default those of all.

    Raises:
        LogError: The log has no such robot.
    """
    names = recording.label.robots
    if robot is not None and robot not in names:
        raise LogError(f"--robot {robot}: not in this log; {choices(robot, names)}")
    return names if robot is None else (robot,)


def chosen_channels(
    recording: Recording, robots: Sequence[str], names: Sequence[str] | None
) -> list[Channel]:
    """Return channels of robots and of the lamps.

    Args:
        recording: Recording of the log.
        robots: Names of the robots.
        names: Names of the channels, in their order; by default all but the registers of the board and of
            turrets with line images, most of which are in other channels, too.

    Raises:
        LogError: The log has no such channel.
    """
    own = {robot: is_khepera4(robot, recording.series) for robot in robots}
    mixed = len({*own.values()}) > 1
    found: dict[str, tuple[str, Columns]] = {}
    for topic, series in recording.series.items():
        owner, _, kind = topic.removeprefix("/").rpartition("/")
        if owner in robots or (not owner and kind.startswith("lamps")):
            khepera4 = own.get(owner, False)
            name, columns = named(kind, series.values.shape[1], khepera4=khepera4, mixed=mixed)
            found.setdefault(name, (kind, columns))
    there = in_order({*found})
    if names is None:
        unasked = {
            "registers",
            f"{KHEPERA4}registers",
            *(kind.name for kind in installed().values() if kind.image),
        }
        names = [name for name in there if name not in unasked]
    for name in names:
        if name not in found:
            raise LogError(f"--channels {name}: not in this log of {told(robots)}; {choices(name, there)}")
    channels: list[Channel] = []
    for name in dict.fromkeys(names):
        kind, columns = found[name]
        shared = f"/{kind}"
        topics = tuple(
            shared
            if shared in recording.series
            else f"/{robot}/{kind}" * (named(kind, 0, khepera4=own[robot], mixed=mixed)[0] == name)
            for robot in robots
        )
        none = TimeSeries(np.zeros(0, np.int64), np.zeros((0, len(columns)), np.int64))
        there = tuple(recording.series.get(topic, none) for topic in topics)
        channels.append(Channel(name, topics, columns, there))
    return channels


def told(robots: Sequence[str]) -> str:
    """Return robots in words: their names, or the number of many."""
    return ", ".join(robots) if len(robots) <= _NAMED else f"{len(robots)} robots"


def write_table(
    log: Path,
    robots: Sequence[str],
    channels: Sequence[Channel],
    kind: str,
    file: BinaryIO,
    progress: Callable[[float], None] | None = None,
) -> int:
    """Write channels as a table, piece by piece; return the number of its rows.

    Args:
        log: Path of the log.
        robots: Names of the robots; of several, the table has a column of them.
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
        writer = TABLES[kind](file, Heading(robots, channels, fractional))
        n_rows, found = 0, set[str]()
        with closing(writer):
            for piece in read_pieces(log, progress):
                parts = [_part(log, channel, piece) for channel in channels]
                found = {each.name for each in parts if each.name not in fractional and not is_whole(each)}
                if found:
                    break
                rows = rows_of(parts, len(robots))
                writer.write(rows, parts)
                n_rows += len(rows.times_ns)
        if not found:
            return n_rows
        fractional |= found


def matrices(
    log: Path,
    robots: Sequence[str],
    channels: Sequence[Channel],
    progress: Callable[[float], None] | None = None,
) -> tuple[bytes, int]:
    """Return channels, transcript and events as the bytes of a MAT file, and the number of a table's rows.

    Raises:
        LogError: The log is not whole, or has more than a MAT file should.
    """
    parts: list[list[Channel]] = [[] for _ in channels]
    lines: dict[str, list[TextLine]] = {topic: [] for topic in (*map(_transcript, robots), "/events")}
    size = 0
    for piece in read_pieces(log, progress):
        for channel, found in zip(channels, parts, strict=True):
            found.append(_part(log, channel, piece))
            size += found[-1].values.size * 8
        for topic, said in lines.items():
            said += piece.lines.get(topic, [])
            size += len(piece.lines.get(topic, ())) * LINE_BYTES
        if size > MAT_BYTES:
            raise LogError(
                f"{log}: more than {MAT_BYTES >> 20} MiB of numbers and text, which is made in memory for a "
                "MAT file; expected a shorter log, fewer --channels, or -o FILE.csv or .parquet"
            )
    several = len(robots) > 1
    values: dict[str, object] = {"robots": _cells(robots)} if several else {}
    wholes = [_joined(found) for found in parts]
    for channel in wholes:
        name, (times_ns, owners, (places,)) = identifier(channel.name), rows_of([channel], len(robots))
        values[name] = channel.values[places].astype(np.float64)
        values[f"{name}_time_s"] = times_ns.reshape(-1, 1) / 1e9
        values[f"{name}_columns"] = _cells([column for column, _ in channel.columns])
        values[f"{name}_units"] = _cells([unit for _, unit in channel.columns])
        if several:
            values[f"{name}_robot"] = owners.reshape(-1, 1) + 1.0
    events = lines.pop("/events")
    serial = _in_order_of_time([*lines.values()])
    for name, said in (("serial", [line for _, line in serial]), ("events", events)):
        values[f"{name}_time_s"] = np.array([line.time_ns / 1e9 for line in said]).reshape(-1, 1)
        values[f"{name}_from"] = _cells([line.name for line in said])
        values[f"{name}_text"] = _cells([line.text for line in said])
    if several:
        values["serial_robot"] = np.array([owner + 1.0 for owner, _ in serial]).reshape(-1, 1)
    return mat_bytes(values, "log"), len(rows_of(wholes, len(robots)).times_ns) if wholes else 0


def write_transcript(
    log: Path, robots: Sequence[str], file: BinaryIO, progress: Callable[[float], None] | None = None
) -> int:
    """Write the transcript of robots' lines as a CSV file, piece by piece; return the number of lines.

    Raises:
        LogError: The log is not whole.
    """
    n_lines = 0
    file.write(b"time_s,robot,from,text\n" if len(robots) > 1 else b"time_s,from,text\n")
    for piece in read_pieces(log, progress):
        text = StringIO()
        lines = _in_order_of_time([piece.lines.get(_transcript(robot), []) for robot in robots])
        names = [[robot] if len(robots) > 1 else [] for robot in robots]
        rows = ([repr(line.time_ns / 1e9), *names[owner], line.name, line.text] for owner, line in lines)
        csv.writer(text, lineterminator="\n").writerows(rows)
        file.write(text.getvalue().encode("utf-8"))
        n_lines += len(lines)
    return n_lines


def _transcript(robot: str) -> str:
    return f"/{robot}/serial"


def _in_order_of_time(lines: Sequence[Sequence[TextLine]]) -> list[tuple[int, TextLine]]:
    """Return the lines of all robots in order of time, each with the index of its robot."""
    owned = [(owner, line) for owner, said in enumerate(lines) for line in said]
    return sorted(owned, key=lambda each: each[1].time_ns)


def _part(log: Path, channel: Channel, piece: Recording) -> Channel:
    """Return a channel with its series in a piece of the log, whose rows must be as long as at its begin."""
    n_columns, none = len(channel.columns), TimeSeries(np.zeros(0, np.int64), channel.series[0].values[:0])
    series = tuple(piece.series.get(topic, none) for topic in channel.topics)
    for topic, each in zip(channel.topics, series, strict=True):
        if each.values.shape[1:] != (n_columns,):
            raise LogError(
                f"{log}: {topic} has {each.values.shape[1]} values at {each.times_ns[0] / 1e9} s, "
                f"expected {n_columns} as at its begin"
            )
    return replace(channel, series=series)


def _joined(parts: Sequence[Channel]) -> Channel:
    """Return a channel of all pieces of a log."""
    series = zip(*(part.series for part in parts), strict=True)
    whole = tuple(
        TimeSeries(
            np.concatenate([each.times_ns for each in found]), np.concatenate([each.values for each in found])
        )
        for found in series
    )
    return replace(parts[0], series=whole)


SUFFIXES = (*TABLES, ".mat")
"""Suffixes of all exports."""


def _cells(texts: Sequence[str]) -> NDArray[np.object_]:
    """Return texts as a column of cells."""
    cells = np.empty((len(texts), 1), object)
    cells[:, 0] = texts
    return cells
