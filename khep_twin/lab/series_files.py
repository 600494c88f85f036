"""The folder of a series: each run is in it as soon as it has ended.

    series.json    settings and all runs so far; what a series goes on from
    runs.csv       a row for each run: start, cycles, time, numbers, and the controller's single variables
    runs.parquet   the same, with units as metadata of the columns
    runs.mat       the same for Matlab, a column each
    run-001.mat    all variables of run 1 as of its end, arrays too, for Matlab's `load`

Nothing of the machine or the hour is in them: the same series gives the same bytes.
"""

# scipy and pyarrow are not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import csv
import json
from collections.abc import Mapping, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from khep_twin import __version__
from khep_twin.errors import ControllerError
from khep_twin.files import write_whole
from khep_twin.lab.measures import UNITS
from khep_twin.lab.series import Run
from khep_twin.lab.setting import Start

Row = Mapping[str, int | float | str | bool]
"""One run as the tables have it: values by the names of their columns."""

_INDEX = "series.json"
_OWN = {"run": "", "start_x_mm": "mm", "start_y_mm": "mm", "start_heading_deg": "degrees", "cycles": ""}
_UNITS = {**_OWN, "duration_s": "s", **UNITS}


class SeriesFolder:
    """A folder in the making, or one to go on with.

    Args:
        path: of the folder.
        settings: of the series: what has to be the same for it to go on.
        resume: whether to go on with what is there.

    Attributes:
        path: of the folder.
        rows: of the runs so far.

    Raises:
        ControllerError: it cannot be made, there is a series in it already, or with `resume` another one.
    """

    def __init__(self, path: Path, settings: Mapping[str, Any], *, resume: bool = False) -> None:
        self.path = path
        self.rows: list[Row] = []
        # As they come back from the file.
        self._settings: dict[str, Any] = json.loads(json.dumps(dict(settings)))
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ControllerError(f"{path}: no folder can be made here: {error.strerror}") from error
        if (path / _INDEX).exists():
            before, rows = read_series(path)
            if not resume:
                raise ControllerError(
                    f"{path}: has a series of {len(rows)} runs already; right is --resume, or another folder"
                )
            for key in sorted({*before, *self._settings}):
                if before.get(key) != self._settings.get(key):
                    raise ControllerError(
                        f"{path}: was made with another {key.replace('_', ' ')}: {_short(before.get(key))}, "
                        f"now {_short(self._settings.get(key))}; right is the same, or another folder"
                    )
            self.rows = rows
        elif resume:
            raise ControllerError(
                f"{path}: holds no series to go on with; right is a folder that --save made"
            )

    def keep(self, run: Run) -> None:
        """Keeps a run; one that is there already has to be the same.

        Raises:
            ControllerError: it came out otherwise than before.
            KhepTwinError: it cannot be written.
        """
        row = row_of(run)
        if run.number <= len(self.rows):
            before = self.rows[run.number - 1]
            for name in columns([before, row]):
                if json.dumps(before.get(name)) != json.dumps(row.get(name)):
                    raise ControllerError(
                        f"{self.path}: run {run.number} came out with {name} {row.get(name)}, before "
                        f"{before.get(name)}; what draws on chance or on time of its own cannot go on"
                    )
            return
        self.rows.append(row)
        write_whole(self.path / f"run-{run.number:03d}.mat", _mat(run.variables, f"run {run.number}"))
        text = json.dumps({"settings": self._settings, "runs": self.rows}, indent=1)
        write_whole(self.path / _INDEX, text.encode("utf-8") + b"\n")
        names = columns(self.rows)
        write_whole(self.path / "runs.csv", _csv(self.rows, names))
        write_whole(self.path / "runs.parquet", _parquet(self.rows, names))
        whole = {name: np.array([[row.get(name, np.nan)] for row in self.rows]) for name in names}
        numeric = {name: values for name, values in whole.items() if values.dtype.kind in "biuf"}
        write_whole(self.path / "runs.mat", _mat(numeric, "series"))


def read_series(path: Path) -> tuple[dict[str, Any], list[Row]]:
    """The settings and the runs of a folder.

    Raises:
        ControllerError: there is no series in it.
    """
    file = path / _INDEX
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        settings: dict[str, Any] = dict(found["settings"])
        rows: list[Row] = [dict(row) for row in found["runs"]]
        if any("run" not in row for row in rows):
            raise ValueError("runs without a number")
    except OSError as error:
        raise ControllerError(f"{file}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, LookupError) as error:
        raise ControllerError(f"{file}: no series of khep_twin: {error}") from error
    return settings, rows


def row_of(run: Run) -> Row:
    """A run as a row of the tables."""
    row: dict[str, Any] = {"run": run.number}
    if run.start is not None:
        row |= {
            "start_x_mm": run.start.x_mm,
            "start_y_mm": run.start.y_mm,
            "start_heading_deg": run.start.heading_deg,
        }
    row |= {"cycles": run.cycles, "duration_s": run.duration, **run.numbers}
    for name, value in run.variables.items():
        if isinstance(value, bool | int | float | str):
            row[name if name not in _UNITS else f"controller_{name}"] = value
    return row


def columns(rows: Sequence[Row]) -> list[str]:
    """Names of the columns that these rows have, the known ones first."""
    there = {name for row in rows for name in row}
    return [name for name in _UNITS if name in there] + sorted(there - {*_UNITS})


def _csv(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([row.get(name, "") for name in names] for row in rows)
    return text.getvalue().encode("utf-8")


def _parquet(rows: Sequence[Row], names: Sequence[str]) -> bytes:
    import pyarrow as arrow
    from pyarrow import parquet

    values = [_alike([row.get(name) for row in rows]) for name in names]
    arrays: list[Any] = [arrow.array(each) for each in values]
    fields: list[Any] = [
        arrow.field(name, array.type, metadata={"unit": _UNITS.get(name, "")})
        for name, array in zip(names, arrays, strict=True)
    ]
    file = BytesIO()
    whole: Any = arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))
    parquet.write_table(whole, file)
    return file.getvalue()


def _alike(values: Sequence[Any]) -> list[Any]:
    """A column's values as one type: what is not all of one kind becomes text."""
    there = [value for value in values if value is not None]
    kinds = [kind for kind in (bool, int, float, str) if any(type(value) is kind for value in there)]
    if len(kinds) <= 1:
        return list(values)
    as_one = float if kinds == [int, float] else str
    return [None if value is None else as_one(value) for value in values]


def _mat(values: Mapping[str, Any], what: str) -> bytes:
    """Variables as the bytes of a MAT file."""
    named = {_identifier(name): np.asarray(value) for name, value in values.items()}
    file = BytesIO()
    savemat(file, named, do_compression=True, oned_as="row")
    # scipy writes the machine and the hour here.
    title = f"MATLAB 5.0 MAT-file, {what} by khep_twin {__version__}".encode("ascii")
    return title.ljust(116) + file.getvalue()[116:]


def _identifier(name: str) -> str:
    """A name as Matlab takes it."""
    plain = "".join(each if each.isascii() and each.isalnum() else "_" for each in name)
    return (plain if plain[:1].isalpha() else f"v{plain}")[:31]


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def start_of(row: Row) -> Start | None:
    """Where a row's run began, None for where the robot happened to stand."""
    if "start_x_mm" not in row:
        return None
    x_mm, y_mm, heading_deg = (float(row[f"start_{name}"]) for name in ("x_mm", "y_mm", "heading_deg"))
    return Start(x_mm, y_mm, heading_deg)
