"""Files of tables that are written in pieces: CSV and Parquet."""

# pyarrow is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.columns import Columns
from khep_twin.log.reader import TimeSeries


@dataclass(frozen=True, slots=True)
class Channel:
    """Channel of robots, or the lamps.

    Attributes:
        name: Name, e.g. "proximity".
        topics: Topic in the log of each robot, e.g. "/khepera0/proximity".
        columns: Names and units of the columns.
        series: Times (n,) [ns] and values (n, columns) of each robot; empty if a robot lacks the channel.
    """

    name: str
    topics: tuple[str, ...]
    columns: Columns
    series: tuple[TimeSeries, ...]

    @property
    def values(self) -> NDArray[np.int64 | np.float64]:
        """Values of all robots, one after another (n, columns)."""
        return np.concatenate([series.values for series in self.series])


class Rows(NamedTuple):
    """Rows of a table.

    Attributes:
        times_ns: Times (n,) [ns].
        robots: Indices of the robots (n,).
        indices: Rows of each channel's values (n,), -1 for none.
    """

    times_ns: NDArray[np.int64]
    robots: NDArray[np.int64]
    indices: list[NDArray[np.int64]]


def rows_of(channels: Sequence[Channel], n_robots: int) -> Rows:
    """Return the rows of a table: one per robot and time of a message, in order of time, then robot."""
    times: list[NDArray[np.int64]] = []
    indices: list[list[NDArray[np.int64]]] = [[] for _ in channels]
    for robot in range(n_robots):
        robot_series = [channel.series[robot] for channel in channels]
        times.append(np.unique(np.concatenate([series.times_ns for series in robot_series])))
        for channel, series, rows in zip(channels, robot_series, indices, strict=True):
            offset = sum(len(previous.times_ns) for previous in channel.series[:robot])
            rows.append(np.full(len(times[-1]), -1))
            rows[-1][np.searchsorted(times[-1], series.times_ns)] = offset + np.arange(len(series.times_ns))
    times_ns = np.concatenate(times)
    by_time = np.argsort(times_ns, kind="stable")
    robots = np.repeat(np.arange(n_robots), [len(robot_times) for robot_times in times])
    return Rows(times_ns[by_time], robots[by_time], [np.concatenate(rows)[by_time] for rows in indices])


class CsvFile:
    """CSV file that is written in pieces.

    Args:
        file: File to write.
        robots: Names of the robots; several ones have a column in the table.
        channels: Channels of the columns.
        fractional: Names of the channels with values that are not integers.
    """

    def __init__(
        self, file: BinaryIO, robots: Sequence[str], channels: Sequence[Channel], fractional: Collection[str]
    ) -> None:
        self._file, self._robots, self._fractional = file, robots, fractional
        names = (name for channel in channels for name, _ in channel.columns)
        file.write(f"{','.join(['time_s', *['robot'][: len(self._robots) - 1], *names])}\n".encode())

    def write(self, rows: Rows, channels: Sequence[Channel]) -> None:
        """Write rows with the values of the channels."""
        columns: list[list[str]] = [[repr(time_ns / 1e9) for time_ns in rows.times_ns.tolist()]]
        if len(self._robots) > 1:
            columns.append([str(self._robots[robot]) for robot in rows.robots.tolist()])
        for channel, indices in zip(channels, rows.indices, strict=True):
            value_rows = indices.tolist()
            for values in _values_to_write(channel, self._fractional).T:
                texts = [*map(repr, values.tolist()), ""]  # the last is for row -1
                columns.append([texts[row] for row in value_rows])
        self._file.write("".join(f"{','.join(row)}\n" for row in zip(*columns, strict=True)).encode())

    def close(self) -> None:
        """Do nothing; the caller closes the file."""


class ParquetFile:
    """Parquet file that is written in pieces, one row group each; the arguments are those of `CsvFile`."""

    def __init__(
        self, file: BinaryIO, robots: Sequence[str], channels: Sequence[Channel], fractional: Collection[str]
    ) -> None:
        import pyarrow as arrow
        from pyarrow import parquet

        self._robots, self._fractional = robots, fractional
        fields = [arrow.field("time_s", arrow.float64(), metadata={"unit": "s"})]
        if len(self._robots) > 1:
            fields.append(arrow.field("robot", arrow.string()))
        for channel in channels:
            arrow_type = arrow.float64() if channel.name in self._fractional else arrow.int64()
            for name, unit in channel.columns:
                fields.append(arrow.field(name, arrow_type, metadata={"unit": unit, "channel": channel.name}))
        self._schema = arrow.schema(fields)
        self._writer = parquet.ParquetWriter(file, self._schema)

    def write(self, rows: Rows, channels: Sequence[Channel]) -> None:
        """Write rows with the values of the channels."""
        import pyarrow as arrow

        columns = [arrow.array(rows.times_ns / 1e9)]
        if len(self._robots) > 1:
            columns.append(arrow.array([self._robots[robot] for robot in rows.robots.tolist()]))
        for channel, indices in zip(channels, rows.indices, strict=True):
            for values in _values_to_write(channel, self._fractional).T:
                # The last is for row -1, a missing value.
                columns.append(arrow.array(np.append(values, 0)[indices], mask=indices < 0))
        self._writer.write_table(arrow.Table.from_arrays(columns, schema=self._schema))

    def close(self) -> None:
        """End the file."""
        self._writer.close()


TABLES: Mapping[str, type[CsvFile] | type[ParquetFile]] = {".csv": CsvFile, ".parquet": ParquetFile}
"""Class of each table format by suffix; a new format is a class like `CsvFile`, and a line here."""


def _values_to_write(channel: Channel, fractional: Collection[str]) -> NDArray[np.generic]:
    """Return a channel's values, as integers unless it is fractional."""
    values = channel.values
    return values if channel.name in fractional else values.astype(np.int64)


def is_integer(channel: Channel) -> bool:
    """Return whether all values are integers."""
    values = channel.values
    return bool(np.isfinite(values).all() and np.array_equal(np.rint(values), values))
