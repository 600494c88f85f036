"""Sensor tests from MAT files, including those of the Khepera Toolbox.

The toolbox stores `dv` and `dlgstr` but not the settings: distance and kind of motion are derived from the
counters.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import MatError, SensorTestError
from khep_twin.files.mat_file import Variable, read_variables
from khep_twin.lab.sensor_test.sensor_test import (
    PULSES_PER_CM,
    PULSES_PER_DEGREE,
    QUANTITIES,
    QuantityName,
    SensorRun,
    SensorTest,
    check_quantity,
)


def read_mat(data: bytes, default: QuantityName | None) -> SensorRun:
    """Read a run from the bytes of a MAT file, Matlab 4 to 7.2; `default` is `what` of `sensor_files.load`.

    Raises:
        SensorTestError: The bytes are not a sensor test.
    """
    try:
        values = read_variables(data)
    except MatError as error:
        raise SensorTestError(str(error)) from None
    quantity = check_quantity(_text(values, "what") or default or "proximity")
    dv = _matrix(values, 2 + len(QUANTITIES[quantity].names))
    times = _numbers(values, "times").reshape(-1) if "times" in values else np.full(len(dv), np.nan)
    if len(times) != len(dv):
        raise SensorTestError(f"times: {len(times)} values; expected {len(dv)}, as many as rows in dv")
    return SensorRun(_test(values, dv, quantity), dv, times, _text(values, "dlgstr"))


def _matrix(values: Mapping[str, Variable], width: int) -> NDArray[np.int64]:
    dv = _numbers(values, "dv")
    if dv.ndim != 2 or dv.shape[1] != width or not len(dv):
        shape = " x ".join(map(str, dv.shape))
        sensors = "eight sensors" if width == 10 else "an image"
        raise SensorTestError(f"dv: is {shape}; expected rows of {width}, two counters and {sensors}")
    # Negated, as comparisons with NaN are false.
    is_invalid = ~((np.abs(dv) < 2**31) & (dv == np.round(dv)))
    if is_invalid.any():
        row, column = (int(indices[0]) for indices in np.nonzero(is_invalid))
        raise SensorTestError(f"dv({row + 1},{column + 1}) = {dv[row, column]}; expected an integer")
    return dv.astype(np.int64)


def _test(values: Mapping[str, Variable], dv: NDArray[np.int64], quantity: QuantityName) -> SensorTest:
    motions = ("linear_cm", "rotate_deg")
    if not values.keys() & {*motions}:
        return _derive_test(quantity, dv)
    linear_cm, rotate_deg = (_number(values, name) if name in values else None for name in motions)
    speed, acceleration, return_to_zero = (
        _integer(values, name) for name in ("speed", "acceleration", "return_to_zero")
    )
    return SensorTest(quantity, linear_cm, rotate_deg, speed, acceleration, bool(return_to_zero))


def _derive_test(quantity: QuantityName, dv: NDArray[np.int64]) -> SensorTest:
    """Return the test derived from the counters."""
    left, right = (int(count) for count in dv[-1, :2])
    if left == right == 0:
        raise SensorTestError("dv: the counters end at 0; expected a robot that has moved")
    if left * right < 0:
        turn = round((right - left) / 2 / PULSES_PER_DEGREE, 2)
        return SensorTest(quantity, None, math.copysign(min(max(abs(turn), 15.0), 360.0), turn), None, None)
    straight = round((left + right) / 2 / PULSES_PER_CM, 2)
    return SensorTest(quantity, math.copysign(min(max(abs(straight), 5.0), 60.0), straight), None, None, None)


def _numbers(values: Mapping[str, Variable], name: str) -> NDArray[np.float64]:
    value = values.get(name)
    if not isinstance(value, np.ndarray):
        raise SensorTestError(f"{name}: missing or not real numbers; expected a matrix of them")
    return value.astype(np.float64)


def _number(values: Mapping[str, Variable], name: str) -> float:
    value = _numbers(values, name)
    if value.size != 1:
        raise SensorTestError(f"{name}: {value.size} values; expected one")
    return float(value.reshape(-1)[0])


def _integer(values: Mapping[str, Variable], name: str) -> int:
    value = _number(values, name)
    if not value.is_integer():
        raise SensorTestError(f"{name} = {value:g}; expected an integer")
    return int(value)


def _text(values: Mapping[str, Variable], name: str) -> str:
    """Return a char matrix as lines; unprintable characters become spaces."""
    rows = values.get(name, ())
    if not isinstance(rows, tuple):
        raise SensorTestError(f"{name}: not a text; expected a char matrix")
    # Matlab pads the rows of a char matrix with spaces.
    text = "\n".join(row.rstrip() for row in rows) if len(rows) > 1 else "".join(rows)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(char if char.isprintable() or char in "\n\t" else " " for char in text)
