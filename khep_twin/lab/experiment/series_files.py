"""Folder of a series; each run is saved when it ends.

    series.json    settings and all runs so far, from which a series is resumed
    runs.csv       one row per run: start, cycles, duration, metrics, and the controller's scalar variables
    runs.parquet   the same, with units as metadata of the columns
    runs.mat       the same for Matlab, one array per column
    run-001.mat    all variables of run 1 at its end, including arrays, for Matlab's `load`

The files depend on neither machine nor time: the same series yields the same bytes.
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
from khep_twin.files.atomic import read_regular, write_atomic
from khep_twin.files.mat_file import mat_bytes
from khep_twin.files.paths import StrPath
from khep_twin.lab.experiment.measures import UNITS
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.process.invocation import command
from khep_twin.renamed import renamed_attribute

Row = Mapping[str, int | float | str | bool]
"""A run as a table row: values by column name."""

_INDEX = "series.json"
_SCALAR_TYPES = (bool, int, float, str)
_NAME_LIMIT = 63
"""Longest variable name in Matlab [characters]."""

_RUN_UNITS = {"run": "", "start_x_mm": "mm", "start_y_mm": "mm", "start_heading_deg": "degrees", "cycles": ""}
_UNITS = {**_RUN_UNITS, "duration_s": "s", **UNITS}


class SeriesFolder:
    """Folder of a new or a resumed series.

    Args:
        path: Path of the folder.
        settings: Settings of the series by name, which must be equal to resume it.
        resume: If true, resume the series in the folder.

    Raises:
        ControllerError: The folder cannot be created, has a series already, or with `resume` a different one.
        KhepTwinError: The folder cannot be written.
    """

    def __init__(self, path: StrPath, settings: Mapping[str, object], *, resume: bool = False) -> None:
        self.path = path = Path(path)
        self._folder = path.absolute()  # a controller may change the working directory
        self.rows: list[Row] = []
        # Round trip through JSON, to compare with settings read from the file.
        self._settings: dict[str, object] = json.loads(json.dumps(dict(settings)))
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ControllerError(f"{path}: no folder can be made here: {error.strerror}") from error
        if (path / _INDEX).exists():
            saved_settings, self.rows = read_series(path)
            if self.rows and not resume:
                raise ControllerError(
                    f"{path}: has a series of {len(self.rows)} runs already",
                    "; expected --resume, or another folder",
                )
            if resume:
                self._compare(saved_settings)
        elif resume:
            raise ControllerError(f"{path}: no series to resume; expected a folder that --save made")
        elif files := sorted([*path.glob("run-*.mat"), *path.glob("runs.*")]):
            raise ControllerError(f"{path}: holds {files[0].name} and no {_INDEX}; expected another folder")
        self._write()

    keep = renamed_attribute("keep", "save")

    def save(self, run: SeriesRun) -> bool:
        """Save a run and return whether it is new; a repeated run must equal the saved one.

        Raises:
            ControllerError: A repeated run differs from the saved one.
            KhepTwinError: The folder cannot be written.
        """
        row = row_of(run)
        if run.number <= len(self.rows):
            saved_row = self.rows[run.number - 1]
            for name in columns([saved_row, row]):
                if json.dumps(saved_row.get(name)) != json.dumps(row.get(name)):
                    raise ControllerError(
                        f"{self.path}: run {run.number}, repeated, has {name} {row.get(name)}, before "
                        f"{saved_row.get(name)}; expected the same: to be resumed, a controller must use no "
                        "random numbers or a clock of its own, and keep what it learns as a Controller"
                    )
            return False
        self.rows.append(row)
        write_atomic(self._folder / f"run-{run.number:03d}.mat", _mat(run.variables, f"run {run.number}"))
        self._write()
        return True

    def _compare(self, saved_settings: Mapping[str, object]) -> None:
        """Raise a `ControllerError` if the settings differ from those of the saved series."""
        for key in sorted({*saved_settings, *self._settings}):
            saved, current = saved_settings.get(key), self._settings.get(key)
            if saved != current:
                saved, current = _first_difference(saved, current)
                raise ControllerError(
                    f"{self.path}: was made with another {key.replace('_', ' ')}: {saved}, now {current}; "
                    "expected the same, or another folder"
                )

    def _write(self) -> None:
        """Write series.json, then the tables of the runs."""
        text = json.dumps({"settings": self._settings, "runs": self.rows}, indent=1)
        write_atomic(self._folder / _INDEX, text.encode("utf-8") + b"\n")
        for suffix, data in tables(self.rows).items() if self.rows else ():
            write_atomic(self._folder / f"runs{suffix}", data)


def read_series(path: StrPath) -> tuple[dict[str, object], list[Row]]:
    """Read the settings and the runs of a folder.

    Raises:
        ControllerError: The folder has no series.
    """
    path = Path(path)
    file = path / _INDEX
    try:
        content = json.loads(read_regular(file).decode("utf-8"))
        settings: dict[str, object] = dict(content["settings"])
        rows: list[Row] = [dict(row) for row in content["runs"]]
        for number, row in enumerate(rows, 1):
            is_plain = {type(value) for value in row.values()} <= {*_SCALAR_TYPES}
            if row["run"] != number or not is_plain:
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
    """Return the table of runs as the bytes of a file, by file suffix."""
    names = columns(rows)
    arrays = {name: np.array([[row.get(name, np.nan)] for row in rows]) for name in names}
    numeric = {name: values for name, values in arrays.items() if values.dtype.kind in "biuf"}
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
        if isinstance(value, _SCALAR_TYPES):
            row[name if name not in _UNITS else f"controller_{name}"] = value
    return row


def columns(rows: Sequence[Row]) -> list[str]:
    """Return the column names of these rows, those with a unit first."""
    present = {name for row in rows for name in row}
    return [name for name in _UNITS if name in present] + sorted(present - {*_UNITS})


def _csv(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    text = StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode("utf-8")


def _parquet(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    columns = [_as_single_type([row.get(name) for row in rows]) for name in names]
    arrays: list[Any] = [arrow.array(values) for values in columns]
    fields: list[object] = [
        arrow.field(name, array.type, metadata={"unit": _UNITS.get(name, "")})
        for name, array in zip(names, arrays, strict=True)
    ]
    file = BytesIO()
    arrow_table: object = arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))
    parquet.write_table(arrow_table, file)
    return file.getvalue()


def _as_single_type(values: Sequence[int | float | str | None]) -> Sequence[int | float | str | None]:
    """Return a column's values with a common type; integers and floats become floats, other mixtures text."""
    present = [value for value in values if value is not None]
    types = [kind for kind in (bool, int, float, str) if any(type(value) is kind for value in present)]
    if len(types) <= 1:
        return values
    convert = float if types == [int, float] else str
    return [None if value is None else convert(value) for value in values]


def _mat(values: Mapping[str, object], description: str) -> bytes:
    """Return variables as the bytes of a MAT file."""
    variables: dict[str, object] = {}
    for name, value in values.items():
        variables[_matlab_name(name, variables)] = np.asarray(value)
    return mat_bytes(variables, description)


def _matlab_name(name: str, used_names: Mapping[str, object]) -> str:
    """Return a name as a Matlab identifier that is not in use."""
    identifier = "".join(char if char.isascii() and char.isalnum() else "_" for char in name)
    identifier = (identifier if identifier[:1].isalpha() else f"v{identifier}")[:_NAME_LIMIT]
    numbered = (f"{identifier[: _NAME_LIMIT - 8]}_{number}" for number in itertools.count(2))
    return next(name for name in itertools.chain([identifier], numbered) if name not in used_names)


def _first_difference(saved: object, current: object) -> tuple[str, str]:
    """Return two shortened settings; for multi-line texts, their first lines that differ."""
    if isinstance(saved, str) and isinstance(current, str):
        pairs = itertools.zip_longest(saved.splitlines(), current.splitlines(), fillvalue="nothing")
        saved, current = next((pair for pair in pairs if pair[0] != pair[1]), (saved, current))
    return _shorten(saved), _shorten(current)


def _shorten(value: object) -> str:
    text = " ".join(str("none" if value is None else value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
