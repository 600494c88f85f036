"""The Khepera Toolbox's graphs of sensor tests: `ddl`, `ddlg`, `ddr`, `ddrg`, `disonel`, and their files.

    dv, khep_pos = tstsense(2, linear_cm=12)
    ddlg(dv, khep_pos)
    dataprnt("wall.pdf")

`dv` has a row per reading: two position counters and eight sensors. `khep_pos` is how far a wheel went in
the test [pulses]. A graph opens a window where there is a screen, and is returned in any case. Neither of the
two has the sensors' kind and the speed: the graph takes those of the test that returned `dv`, or the
arguments.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import SensorTestError
from khep_twin.files.paths import StrPath
from khep_twin.lab.sensor_test.sensor_test import (
    PULSES_PER_CM,
    PULSES_PER_DEGREE,
    SensorRun,
    SensorTest,
    QuantityName,
)
from khep_twin.toolbox.sense import test_of
from khep_twin.toolbox.windows import show
from khep_twin.units import SENSOR_LABELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Matrix = NDArray[np.generic] | Sequence[Sequence[SupportsFloat]]
"""Readings `dv` (n, 10)."""


def ddl(
    dv: Matrix, khep_pos: SupportsFloat, what: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw all sensors over a straight path, which counts down to 0 cm at its end.

    Args:
        dv: Readings of the test (n, 10).
        khep_pos: Distance that it went [pulses], 5 to 60 cm.
        what: Kind of sensors, "proximity" or "light"; without, that of the test that returned `dv`.
        speed: Speed that was driven [pulses/10 ms]; likewise, and none is named where it is unknown.

    Raises:
        SensorTestError: `dv` is no such matrix, or no test goes so far.
    """
    return _drawn(dv, khep_pos, "linear", what, speed)


def ddlg(
    dv: Matrix, khep_pos: SupportsFloat, what: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw the graph of `ddl` with a grid."""
    return _drawn(dv, khep_pos, "linear", what, speed, grid=True)


def ddr(
    dv: Matrix, khep_pos: SupportsFloat, what: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw all sensors over a turn, in degrees; arguments as for `ddl`, 15 to 360 degrees."""
    return _drawn(dv, khep_pos, "rotational", what, speed)


def ddrg(
    dv: Matrix, khep_pos: SupportsFloat, what: QuantityName | None = None, *, speed: int | None = None
) -> "Figure":
    """Draw the graph of `ddr` with a grid."""
    return _drawn(dv, khep_pos, "rotational", what, speed, grid=True)


def disonel(
    dv: Matrix,
    khep_pos: SupportsFloat,
    which_one: int | str,
    what: QuantityName | None = None,
    *,
    y_min: int = 0,
    grid: bool = False,
    speed: int | None = None,
) -> "Figure":
    """Draw one sensor over the straight path or the turn; the counters show which it was.

    Args:
        dv: Readings of the test (n, 10).
        khep_pos: Distance that it went [pulses].
        which_one: Sensor, 1 to 8 in the order of `rps`, or its name, such as "left 10".
        what: Kind of sensors, as for `ddl`.
        y_min: Lower end of the axis of counts.
        grid: Draw a grid.
        speed: Speed that was driven, as for `ddl`.

    Raises:
        SensorTestError: There is no such sensor, or as for `ddl`.
    """
    numbers = range(1, len(SENSOR_LABELS) + 1)
    if which_one not in numbers and which_one not in SENSOR_LABELS:
        found = f"which_one = {which_one!r}: no such sensor"
        raise SensorTestError(found, key="which_one", value=which_one, expected=SENSOR_LABELS)
    sensor = which_one if isinstance(which_one, str) else SENSOR_LABELS[which_one - 1]
    rows = _matrix(dv)
    motion = "rotational" if rows[-1, 0] * rows[-1, 1] < 0 else "linear"
    return _drawn(dv, khep_pos, motion, what, speed, sensor=sensor, y_min=y_min, grid=grid)


def dataprnt(file: StrPath = "graph_data.pdf") -> Path:
    """Write the latest graph on a page to print: as PDF, or as PNG or SVG by the name's suffix.

    A file of the default name that is no graph, or a changed one, is kept; the graph gets another name.

    Raises:
        SensorTestError: There is no graph yet.
        KhepTwinError: The file cannot be written, or has another suffix, or a file is kept.
    """
    from khep_twin.drawing import map as drawing

    if not _graphs:
        raise SensorTestError("there is no graph yet; expected ddl, ddlg, ddr, ddrg or disonel before")
    drawing.save(_graphs[-1], Path(file), replace=str(file) not in ("graph_data.pdf", "graph_data.svg"))
    return Path(file)


def datameta(file: StrPath = "graph_data.svg") -> Path:
    """Write the latest graph for a text: as SVG, which scales as the toolbox's metafile does."""
    return dataprnt(file)


_graphs: list["Figure"] = []
"""Latest graph."""


def _drawn(
    dv: Matrix,
    khep_pos: SupportsFloat,
    motion: Literal["linear", "rotational"],
    what: QuantityName | None,
    speed: int | None,
    *,
    sensor: str | None = None,
    y_min: int = 0,
    grid: bool = False,
) -> "Figure":
    from khep_twin.lab.sensor_test import sensor_figure

    rows = _matrix(dv)
    left, right = int(rows[-1, 0]), int(rows[-1, 1])
    driven = test_of(dv)
    what = what or (driven.what if driven else "proximity")
    speed = speed if speed is not None or driven is None else driven.speed
    linear_cm = _amount(khep_pos, left + right, PULSES_PER_CM) if motion == "linear" else None
    rotate_deg = _amount(khep_pos, right - left, PULSES_PER_DEGREE) if motion == "rotational" else None
    test = SensorTest(what, linear_cm, rotate_deg, speed, None)
    run = SensorRun(test, rows, np.full(len(rows), np.nan))
    figure = sensor_figure.draw([run], sensor=sensor, y_min=y_min, grid=grid)
    _graphs[:] = [figure]
    show(figure, "graph_data")
    return figure


def _matrix(dv: Matrix) -> NDArray[np.int64]:
    rows = np.asarray(dv, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 10 or not len(rows):
        shape = " x ".join(map(str, rows.shape))
        raise SensorTestError(f"dv: is {shape}; expected rows of 10, two counters and eight sensors")
    # In this order, as a comparison with NaN is false.
    if not ((np.abs(rows) < 2**31) & (rows == np.round(rows))).all():
        raise SensorTestError("dv: not all are integers; expected counters and counts")
    return rows.astype(np.int64)


def _amount(khep_pos: SupportsFloat, direction: int, scale: float) -> float:
    """Return the distance or angle of a test [cm or degrees], below 0 if the counters fell."""
    amount = abs(float(khep_pos)) / scale
    # Pulses are whole: 15 degrees are 85 pulses, which are 14.98 degrees.
    if amount < 1e6 and abs(amount - round(amount)) * scale <= 0.5:
        amount = float(round(amount))
    return -amount if direction < 0 else amount
