"""The Khepera Toolbox's graphs of sensor tests: `ddl`, `ddlg`, `ddr`, `ddrg`, `disonel`, and their files.

    dv, khep_pos = tstsense(2, linear_cm=12)
    ddlg(dv, khep_pos)
    dataprnt("wall.pdf")

`dv` has a row per reading: two position counters and eight sensors. `khep_pos` is the distance of a wheel in
the test [pulses]. A graph is returned, and opens a window where there is a screen. Quantity and speed are
arguments, or those of the test that returned `dv`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from khep_twin import drawing
from khep_twin.errors import SensorTestError
from khep_twin.files.paths import StrPath
from khep_twin.lab.sensor_test.sensor_test import (
    PULSES_PER_CM,
    PULSES_PER_DEGREE,
    QuantityName,
    SensorRun,
    SensorTest,
)
from khep_twin.renamed import renamed_arguments
from khep_twin.toolbox.sense import find_test
from khep_twin.toolbox.windows import show
from khep_twin.units import SENSOR_LABELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Matrix = NDArray[np.generic] | Sequence[Sequence[SupportsFloat]]
"""Readings `dv` (n, 10)."""

_latest_graph: list["Figure"] = []
"""Latest graph, or empty."""


@renamed_arguments(what="quantity")
def ddl(
    dv: Matrix, khep_pos: SupportsFloat, quantity: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw all sensors over a straight path, which counts down to 0 cm at its end.

    Args:
        dv: Readings of the test (n, 10).
        khep_pos: Distance of a wheel [pulses], 5 to 60 cm.
        quantity: "proximity" or "light"; without, that of the test that returned `dv`.
        speed: Speed of the test [pulses/10 ms]; likewise, or none in the title if it is unknown.

    Raises:
        SensorTestError: `dv` is no (n, 10) matrix, or the distance is out of range.
    """
    return _draw(dv, khep_pos, "linear", quantity, speed)


@renamed_arguments(what="quantity")
def ddlg(
    dv: Matrix, khep_pos: SupportsFloat, quantity: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw the graph of `ddl` with a grid."""
    return _draw(dv, khep_pos, "linear", quantity, speed, grid=True)


@renamed_arguments(what="quantity")
def ddr(
    dv: Matrix, khep_pos: SupportsFloat, quantity: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw all sensors over a turn, in degrees; arguments as for `ddl`, 15 to 360 degrees."""
    return _draw(dv, khep_pos, "rotational", quantity, speed)


@renamed_arguments(what="quantity")
def ddrg(
    dv: Matrix, khep_pos: SupportsFloat, quantity: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw the graph of `ddr` with a grid."""
    return _draw(dv, khep_pos, "rotational", quantity, speed, grid=True)


@renamed_arguments(what="quantity")
def disonel(
    dv: Matrix,
    khep_pos: SupportsFloat,
    which_one: int | str,
    quantity: QuantityName | None = None,
    *,
    y_min: int = 0,
    grid: bool = False,
    speed: int | None = None,
) -> "Figure":
    """Draw one sensor over the straight path or the turn, by the signs of the counters.

    Args:
        dv: Readings of the test (n, 10).
        khep_pos: Distance of a wheel [pulses].
        which_one: Sensor, 1 to 8 in the order of `rps`, or its name, e.g. "left 10".
        quantity: Quantity, as for `ddl`.
        y_min: Lower end of the axis of counts.
        grid: Draw a grid.
        speed: Speed of the test, as for `ddl`.

    Raises:
        SensorTestError: The sensor does not exist, or as for `ddl`.
    """
    numbers = range(1, len(SENSOR_LABELS) + 1)
    if which_one not in numbers and which_one not in SENSOR_LABELS:
        text = f"which_one = {which_one!r}: no such sensor"
        raise SensorTestError(text, key="which_one", value=which_one, expected=SENSOR_LABELS)
    sensor = which_one if isinstance(which_one, str) else SENSOR_LABELS[which_one - 1]
    rows = _matrix(dv)
    motion = "rotational" if rows[-1, 0] * rows[-1, 1] < 0 else "linear"
    return _draw(dv, khep_pos, motion, quantity, speed, sensor=sensor, y_min=y_min, grid=grid)


def dataprnt(file: StrPath = "graph_data.pdf") -> Path:
    """Write the latest graph on a page for printing: PDF, PNG or SVG by the name's suffix.

    A file of the default name is kept if it is no graph, or a changed one; the new graph gets another name.

    Raises:
        SensorTestError: There is no graph yet.
        KhepTwinError: The file cannot be written, or has another suffix, or a file is kept.
    """
    if not _latest_graph:
        raise SensorTestError("there is no graph yet; expected ddl, ddlg, ddr, ddrg or disonel before")
    drawing.save(_latest_graph[-1], Path(file), replace=str(file) not in ("graph_data.pdf", "graph_data.svg"))
    return Path(file)


def datameta(file: StrPath = "graph_data.svg") -> Path:
    """Write the latest graph for a document: as SVG, which scales like the toolbox's metafile."""
    return dataprnt(file)


def _draw(
    dv: Matrix,
    khep_pos: SupportsFloat,
    motion: Literal["linear", "rotational"],
    quantity: QuantityName | None,
    speed: int | None,
    *,
    sensor: str | None = None,
    y_min: int = 0,
    grid: bool = False,
) -> "Figure":
    """Draw and show a graph, the latest one from now on; arguments as for `disonel`."""
    from khep_twin.lab.sensor_test import sensor_figure

    rows = _matrix(dv)
    left, right = int(rows[-1, 0]), int(rows[-1, 1])
    latest_test = find_test(dv)
    quantity = quantity or (latest_test.what if latest_test else "proximity")
    speed = speed if speed is not None or latest_test is None else latest_test.speed
    linear_cm = _signed_amount(khep_pos, left + right, PULSES_PER_CM) if motion == "linear" else None
    rotate_deg = _signed_amount(khep_pos, right - left, PULSES_PER_DEGREE) if motion == "rotational" else None
    test = SensorTest(quantity, linear_cm, rotate_deg, speed, None)
    run = SensorRun(test, rows, np.full(len(rows), np.nan))
    figure = sensor_figure.draw([run], sensor=sensor, y_min=y_min, grid=grid)
    _latest_graph[:] = [figure]
    show(figure, "graph_data")
    return figure


def _matrix(dv: Matrix) -> NDArray[np.int64]:
    rows = np.asarray(dv, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 10 or not len(rows):
        shape = " x ".join(map(str, rows.shape))
        raise SensorTestError(f"dv: is {shape}; expected rows of 10, two counters and eight sensors")
    # Not `any(>=)`, as a comparison with NaN is false.
    if not ((np.abs(rows) < 2**31) & (rows == np.round(rows))).all():
        raise SensorTestError("dv: not all are integers; expected counters and counts")
    return rows.astype(np.int64)


def _signed_amount(khep_pos: SupportsFloat, counter_sum: int, pulses_per_unit: float) -> float:
    """Return the distance or angle of a test [cm or degrees], negative if `counter_sum` [pulses] is."""
    amount = abs(float(khep_pos)) / pulses_per_unit
    # Pulses are integers: 15 degrees are 85 pulses, which are 14.98 degrees.
    if amount < 1e6 and abs(amount - round(amount)) * pulses_per_unit <= 0.5:
        amount = float(round(amount))
    return -amount if counter_sum < 0 else amount
