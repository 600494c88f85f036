"""Export of logs as tables: CSV, Parquet for data frames, and MAT for Matlab.

    .csv      one table: time_s and a column for each value, a row for each time of a message
    .parquet  the same table, with unit and channel as metadata of each column
    .mat      a matrix for each channel with its own times: proximity, proximity_time_s, proximity_columns;
              transcript and events as cells

A table of several robots has their names in the column `robot`, and a row for each robot and time. A MAT file
has the robots of the rows of `proximity`, numbered from 1, in proximity_robot. In a table of several
families of robots, the names of channels that differ from a Khepera's start with the family's name. Cells are
empty where a channel has no value at a time. The same log gives the same bytes.
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

from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import LogError, choices
from khep_twin.files.mat_file import mat_bytes
from khep_twin.lab.report.table_files import TABLES, Channel, is_integer, rows_of
from khep_twin.log.channels import TextLine
from khep_twin.log.columns import Columns, name_columns, order_channels, to_identifier
from khep_twin.log.reader import Recording, TimeSeries, read_batches
from khep_twin.log.robot_models import models_of
from khep_twin.robots.registry import default_model

MAT_BYTES = 512 << 20
"""Largest size of numbers and text in a MAT file [bytes]; building it takes several times this memory."""

LINE_BYTES = 100
"""Assumed size of a line of the transcript [bytes]."""

SUFFIXES = (*TABLES, ".mat")
"""Suffixes of all exports."""

_MAX_NAMED = 5
"""Largest number of robots that messages list by name."""


def check_suffix(path: Path) -> str:
    """Return a file's suffix in lower case.

    Raises:
        LogError: The suffix is not in `SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        *first, last = SUFFIXES
        raise LogError(f"{path}; expected a name that ends in {', '.join(first)} or {last}")
    return path.suffix.lower()


def choose_robots(recording: Recording, robot: str | None) -> tuple[str, ...]:
    """Return the name of the chosen robot, by default the names of all robots.

    Raises:
        LogError: The log has no such robot.
    """
    names = recording.label.robots
    if robot is not None and robot not in names:
        raise LogError(f"--robot {robot}: not in this log; {choices(robot, names)}")
    return names if robot is None else (robot,)


def choose_channels(
    recording: Recording, robots: Sequence[str], names: Sequence[str] | None
) -> list[Channel]:
    """Return the chosen channels of robots and lamps.

    Args:
        recording: Recording of the log.
        robots: Names of the robots.
        names: Names of the channels, in order; by default all but the registers of the board and of turrets
            with line images, most of which are also in other channels.

    Raises:
        LogError: The log has no such channel.
    """
    models = models_of(recording.label.attachments, robots, recording.series)
    families = {model.family for model in models.values()}
    available: dict[str, tuple[str, Columns]] = {}
    for topic, series in recording.series.items():
        owner, _, kind = topic.removeprefix("/").rpartition("/")
        if owner in robots or (not owner and kind.startswith("lamps")):
            model = models.get(owner, default_model())
            name, columns = name_columns(kind, series.values.shape[1], model, families)
            available.setdefault(name, (kind, columns))
    known_names = order_channels({*available})
    if names is None:
        omitted = {name for name in known_names if available[name][0] == "registers"}
        omitted |= {turret.name for turret in installed_turrets().values() if turret.image}
        names = [name for name in known_names if name not in omitted]
    for name in names:
        if name not in available:
            problem = f"--channels {name}: not in this log of {describe_robots(robots)}"
            raise LogError(f"{problem}; {choices(name, known_names)}")
    channels: list[Channel] = []
    for name in dict.fromkeys(names):
        kind, columns = available[name]
        shared = f"/{kind}"
        topics = tuple(
            shared
            if shared in recording.series
            else f"/{robot}/{kind}" * (name_columns(kind, 0, models[robot], families)[0] == name)
            for robot in robots
        )
        empty = TimeSeries(np.zeros(0, np.int64), np.zeros((0, len(columns)), np.int64))
        series = tuple(recording.series.get(topic, empty) for topic in topics)
        channels.append(Channel(name, topics, columns, series))
    return channels


def describe_robots(robots: Sequence[str]) -> str:
    """Return the names of robots as a text, or the number of many robots."""
    return ", ".join(robots) if len(robots) <= _MAX_NAMED else f"{len(robots)} robots"


def write_table(
    log: Path,
    robots: Sequence[str],
    channels: Sequence[Channel],
    kind: str,
    file: BinaryIO,
    progress: Callable[[float], None] | None = None,
) -> int:
    """Write channels as a table, in pieces; return the number of its rows.

    Args:
        log: Path of the log.
        robots: Names of the robots; several ones have a column in the table.
        channels: Columns of the table, from `choose_channels`; their series are not used.
        kind: Suffix, a key of `TABLES`.
        file: File to write, which must also be readable.
        progress: Called with the completed fraction, 0 to 1.

    Raises:
        LogError: The log is incomplete.
    """
    # Messages store counts as floats: columns are integers unless a fraction is found, then all is rewritten.
    fractional = {channel.name for channel in channels} & {"pose", "lamps"}
    while True:
        file.seek(0)
        file.truncate()
        writer = TABLES[kind](file, robots, channels, fractional)
        n_rows, fractional_names = 0, set[str]()
        with closing(writer):
            for batch in read_batches(log, progress):
                batch_channels = [_channel_of_batch(log, channel, batch) for channel in channels]
                others = (channel for channel in batch_channels if channel.name not in fractional)
                fractional_names = {channel.name for channel in others if not is_integer(channel)}
                if fractional_names:
                    break
                rows = rows_of(batch_channels, len(robots))
                writer.write(rows, batch_channels)
                n_rows += len(rows.times_ns)
        if not fractional_names:
            return n_rows
        fractional |= fractional_names


def matrices(
    log: Path,
    robots: Sequence[str],
    channels: Sequence[Channel],
    progress: Callable[[float], None] | None = None,
) -> tuple[bytes, int]:
    """Return channels, transcript and events as the bytes of a MAT file, and the number of a table's rows.

    Raises:
        LogError: The log is incomplete, or too large for a MAT file.
    """
    parts: list[list[Channel]] = [[] for _ in channels]
    lines: dict[str, list[TextLine]] = {topic: [] for topic in (*map(_transcript_topic, robots), "/events")}
    size = 0
    for piece in read_batches(log, progress):
        for channel, pieces in zip(channels, parts, strict=True):
            pieces.append(_channel_of_batch(log, channel, piece))
            size += pieces[-1].values.size * 8
        for topic, entries in lines.items():
            entries += piece.lines.get(topic, [])
            size += len(piece.lines.get(topic, ())) * LINE_BYTES
        if size > MAT_BYTES:
            raise LogError(
                f"{log}: more than {MAT_BYTES >> 20} MiB of numbers and text, which is made in memory for a "
                "MAT file; expected a shorter log, fewer --channels, or -o FILE.csv or .parquet"
            )
    has_several_robots = len(robots) > 1
    values: dict[str, object] = {"robots": _cell_column(robots)} if has_several_robots else {}
    merged = [_merge(pieces) for pieces in parts]
    for channel in merged:
        name, (times_ns, owners, (indices,)) = to_identifier(channel.name), rows_of([channel], len(robots))
        values[name] = channel.values[indices].astype(np.float64)
        values[f"{name}_time_s"] = times_ns.reshape(-1, 1) / 1e9
        values[f"{name}_columns"] = _cell_column([column for column, _ in channel.columns])
        values[f"{name}_units"] = _cell_column([unit for _, unit in channel.columns])
        if has_several_robots:
            values[f"{name}_robot"] = owners.reshape(-1, 1) + 1.0
    events = lines.pop("/events")
    serial = _sort_lines([*lines.values()])
    for name, entries in (("serial", [line for _, line in serial]), ("events", events)):
        values[f"{name}_time_s"] = np.array([line.time_ns / 1e9 for line in entries]).reshape(-1, 1)
        values[f"{name}_from"] = _cell_column([line.name for line in entries])
        values[f"{name}_text"] = _cell_column([line.text for line in entries])
    if has_several_robots:
        values["serial_robot"] = np.array([owner + 1.0 for owner, _ in serial]).reshape(-1, 1)
    return mat_bytes(values, "log"), len(rows_of(merged, len(robots)).times_ns) if merged else 0


def write_transcript(
    log: Path, robots: Sequence[str], file: BinaryIO, progress: Callable[[float], None] | None = None
) -> int:
    """Write the transcript of robots' serial lines as a CSV file, in pieces; return the number of lines.

    Raises:
        LogError: The log is incomplete.
    """
    n_lines = 0
    file.write(b"time_s,robot,from,text\n" if len(robots) > 1 else b"time_s,from,text\n")
    for piece in read_batches(log, progress):
        text = StringIO()
        lines = _sort_lines([piece.lines.get(_transcript_topic(robot), []) for robot in robots])
        names = [[robot] if len(robots) > 1 else [] for robot in robots]
        rows = ([repr(line.time_ns / 1e9), *names[owner], line.name, line.text] for owner, line in lines)
        csv.writer(text, lineterminator="\n").writerows(rows)
        file.write(text.getvalue().encode("utf-8"))
        n_lines += len(lines)
    return n_lines


def _transcript_topic(robot: str) -> str:
    return f"/{robot}/serial"


def _sort_lines(lines: Sequence[Sequence[TextLine]]) -> list[tuple[int, TextLine]]:
    """Return the lines of all robots in order of time, each with the index of its robot."""
    pairs = [(owner, line) for owner, robot_lines in enumerate(lines) for line in robot_lines]
    return sorted(pairs, key=lambda pair: pair[1].time_ns)


def _channel_of_batch(log: Path, channel: Channel, batch: Recording) -> Channel:
    """Return a channel with its series in a piece of the log; its number of columns may not change."""
    n_columns, empty = len(channel.columns), TimeSeries(np.zeros(0, np.int64), channel.series[0].values[:0])
    series = tuple(batch.series.get(topic, empty) for topic in channel.topics)
    for topic, part in zip(channel.topics, series, strict=True):
        if part.values.shape[1:] != (n_columns,):
            raise LogError(
                f"{log}: {topic} has {part.values.shape[1]} values at {part.times_ns[0] / 1e9} s, "
                f"expected {n_columns} as at its begin"
            )
    return replace(channel, series=series)


def _merge(parts: Sequence[Channel]) -> Channel:
    """Return a channel merged from all pieces of a log."""
    series = zip(*(part.series for part in parts), strict=True)
    merged = tuple(
        TimeSeries(
            np.concatenate([part.times_ns for part in pieces]),
            np.concatenate([part.values for part in pieces]),
        )
        for pieces in series
    )
    return replace(parts[0], series=merged)


def _cell_column(texts: Sequence[str]) -> NDArray[np.object_]:
    """Return texts as a column of cells."""
    cells = np.empty((len(texts), 1), object)
    cells[:, 0] = texts
    return cells
