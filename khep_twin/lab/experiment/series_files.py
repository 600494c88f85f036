"""Folder of a series; each run is saved as soon as it has ended.

    series.json    settings and all runs so far, from which a series is resumed
    runs.csv       a row for each run: start, cycles, time, numbers, and the controller's single variables
    runs.parquet   the same, with units as metadata of the columns
    runs.mat       the same for Matlab, a column each
    run-001.mat    all variables of run 1 as of its end, arrays too, for Matlab's `load`

The files depend on neither machine nor time: the same series gives the same bytes.
"""

# scipy and pyarrow are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import csv
import itertools
import json
from collections.abc import Mapping, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np

from khep_twin.errors import ControllerError
from khep_twin.files.atomic import read_regular, write_whole
from khep_twin.files.mat_file import mat_bytes
from khep_twin.files.paths import StrPath
from khep_twin.invocation import command
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.series_run import SeriesRun

Row = Mapping[str, int | float | str | bool]
"""A run as a table row: values by column name."""

_INDEX = "series.json"
_SINGLE = (bool, int, float, str)
_NAME_LIMIT = 63
"""Longest variable name in Matlab [characters]."""

_OWN = {"run": "", "start_x_mm": "mm", "start_y_mm": "mm", "start_heading_deg": "degrees", "cycles": ""}
_UNITS = {**_OWN, "duration_s": "s", **UNITS}


class SeriesFolder:
    """Folder of a new or a resumed series.

    Args:
        path: Path of the folder.
        settings: Settings of the series by name, which must be the same to resume it.
        resume: If true, resume the series in the folder.

    Raises:
        ControllerError: It cannot be made, has a series already, or with `resume` another one.
        KhepTwinError: It cannot be written.
    """

    def __init__(self, path: StrPath, settings: Mapping[str, object], *, resume: bool = False) -> None:
        self.path = path = Path(path)
        self._place = path.absolute()  # a controller may go to another folder
        self.rows: list[Row] = []
        # Round trip through JSON, to compare with settings read from the file.
        self._settings: dict[str, object] = json.loads(json.dumps(dict(settings)))
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ControllerError(f"{path}: no folder can be made here: {error.strerror}") from error
        if (path / _INDEX).exists():
            before, self.rows = read_series(path)
            if self.rows and not resume:
                raise ControllerError(
                    f"{path}: has a series of {len(self.rows)} runs already",
                    "; expected --resume, or another folder",
                )
            if resume:
                self._compare(before)
        elif resume:
            raise ControllerError(f"{path}: no series to resume; expected a folder that --save made")
        elif taken := sorted([*path.glob("run-*.mat"), *path.glob("runs.*")]):
            raise ControllerError(f"{path}: holds {taken[0].name} and no {_INDEX}; expected another folder")
        self._write()

    def keep(self, run: SeriesRun) -> bool:
        """Save a run and return whether it is new; a repeated run must equal the saved one.

        Raises:
            ControllerError: A repeated run differs from the saved one.
            KhepTwinError: It cannot be written.
        """
        row = row_of(run)
        if run.number <= len(self.rows):
            before = self.rows[run.number - 1]
            for name in columns([before, row]):
                if json.dumps(before.get(name)) != json.dumps(row.get(name)):
                    raise ControllerError(
                        f"{self.path}: run {run.number}, repeated, has {name} {row.get(name)}, before "
                        f"{before.get(name)}; expected the same: to be resumed, a controller must use no "
                        "random numbers or a clock of its own, and keep what it learns as a Controller"
                    )
            return False
        self.rows.append(row)
        write_whole(self._place / f"run-{run.number:03d}.mat", _mat(run.variables, f"run {run.number}"))
        self._write()
        return True

    def _compare(self, before: Mapping[str, object]) -> None:
        """Raise a `ControllerError` if settings differ from those of the series."""
        for key in sorted({*before, *self._settings}):
            was, now = before.get(key), self._settings.get(key)
            if was != now:
                was, now = _where_they_differ(was, now)
                raise ControllerError(
                    f"{self.path}: was made with another {key.replace('_', ' ')}: {was}, now {now}; expected "
                    "the same, or another folder"
                )

    def _write(self) -> None:
        """Write all but the runs' own files, series.json first."""
        text = json.dumps({"settings": self._settings, "runs": self.rows}, indent=1)
        write_whole(self._place / _INDEX, text.encode("utf-8") + b"\n")
        for suffix, data in tables(self.rows).items() if self.rows else ():
            write_whole(self._place / f"runs{suffix}", data)


def read_series(path: StrPath) -> tuple[dict[str, object], list[Row]]:
    """Read the settings and the runs of a folder.

    Raises:
        ControllerError: There is no series in it.
    """
    path = Path(path)
    file = path / _INDEX
    try:
        found = json.loads(read_regular(file).decode("utf-8"))
        settings: dict[str, object] = dict(found["settings"])
        rows: list[Row] = [dict(row) for row in found["runs"]]
        for number, row in enumerate(rows, 1):
            plain = {type(value) for value in row.values()} <= {*_SINGLE}
            if row["run"] != number or not plain:
                raise ValueError(f"runs: entry {number} is not run {number}")
    except FileNotFoundError:
        remedy = f"; to make one: {command('run', '--runs', 5, '--save', path)}"
        raise ControllerError(f"{path}: no series here, as it has no {_INDEX}", remedy) from None
    except OSError as error:
        raise ControllerError(f"{file}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        raise ControllerError(f"{file}: not a series of khep_twin: {error}") from error
    return settings, rows


def tables(rows: Sequence[Row]) -> dict[str, bytes]:
    """Return the table of runs as the bytes of files, by their suffix."""
    names = columns(rows)
    whole = {name: np.array([[row.get(name, np.nan)] for row in rows]) for name in names}
    numeric = {name: values for name, values in whole.items() if values.dtype.kind in "biuf"}
    return {".csv": _csv(rows, names), ".parquet": _parquet(rows, names), ".mat": _mat(numeric, "series")}


def row_of(run: SeriesRun) -> Row:
    """Return a run as a row of the tables."""
    row: dict[str, int | float | str | bool] = {"run": run.number}
    if run.start is not None:
        row |= {
            "start_x_mm": run.start.x_mm,
            "start_y_mm": run.start.y_mm,
            "start_heading_deg": run.start.heading_deg,
        }
    row |= {"cycles": run.cycles, "duration_s": run.duration, **run.metrics}
    for name, value in run.variables.items():
        if isinstance(value, _SINGLE):
            row[name if name not in _UNITS else f"controller_{name}"] = value
    return row


def columns(rows: Sequence[Row]) -> list[str]:
    """Return the names of the columns of these rows, the known ones first."""
    there = {name for row in rows for name in row}
    return [name for name in _UNITS if name in there] + sorted(there - {*_UNITS})


def _csv(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    text = StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode("utf-8")


def _parquet(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    values = [_alike([row.get(name) for row in rows]) for name in names]
    arrays: list[Any] = [arrow.array(each) for each in values]
    fields: list[object] = [
        arrow.field(name, array.type, metadata={"unit": _UNITS.get(name, "")})
        for name, array in zip(names, arrays, strict=True)
    ]
    file = BytesIO()
    whole: object = arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))
    parquet.write_table(whole, file)
    return file.getvalue()


def _alike(values: Sequence[int | float | str | None]) -> Sequence[int | float | str | None]:
    """Return a column's values as one type; mixed types become text."""
    there = [value for value in values if value is not None]
    kinds = [kind for kind in (bool, int, float, str) if any(type(value) is kind for value in there)]
    if len(kinds) <= 1:
        return values
    as_one = float if kinds == [int, float] else str
    return [None if value is None else as_one(value) for value in values]


def _mat(values: Mapping[str, object], what: str) -> bytes:
    """Return variables as the bytes of a MAT file."""
    named: dict[str, object] = {}
    for name, value in values.items():
        named[_identifier(name, named)] = np.asarray(value)
    return mat_bytes(named, what)


def _identifier(name: str, taken: Mapping[str, object]) -> str:
    """Return a name as a Matlab identifier that is not taken."""
    plain = "".join(each if each.isascii() and each.isalnum() else "_" for each in name)
    plain = (plain if plain[:1].isalpha() else f"v{plain}")[:_NAME_LIMIT]
    numbered = (f"{plain[: _NAME_LIMIT - 8]}_{number}" for number in itertools.count(2))
    return next(name for name in itertools.chain([plain], numbered) if name not in taken)


def _where_they_differ(one: object, other: object) -> tuple[str, str]:
    """Return two settings shortened; of texts with several lines, the first line that differs."""
    if isinstance(one, str) and isinstance(other, str):
        pairs = itertools.zip_longest(one.splitlines(), other.splitlines(), fillvalue="nothing")
        one, other = next((pair for pair in pairs if pair[0] != pair[1]), (one, other))
    return _short(one), _short(other)


def _short(value: object) -> str:
    text = " ".join(str("none" if value is None else value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
