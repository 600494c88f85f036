"""Reading sensor tests from MAT files, the Khepera Toolbox's own among them.

The toolbox wrote `dv` and `dlgstr` and nothing of the test: how far the robot went, and whether it drove
straight or turned, is then told from its counters.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import struct
import warnings
import zlib
from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from khep_twin.errors import SensorTestError
from khep_twin.lab.sensor_test import PULSES_PER_CM, PULSES_PER_DEGREE, SensorRun, SensorTest, What

_DAMAGE = (
    MatReadError,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    LookupError,
    ValueError,
    TypeError,
    AttributeError,
    NotImplementedError,
    ArithmeticError,
    MemoryError,
)
"""What scipy raises, depending on where a file is damaged."""

_FIELDS = ("dv", "dlgstr", "times", "what", "linear_cm", "rotate_deg", "speed", "acceleration")


def read_mat(data: bytes, what: What | None) -> SensorRun:
    """A run from the bytes of a MAT file, Matlab 4 to 7.2.

    Args:
        data: the file.
        what: the sensors told, in a file that says nothing of it; without, proximity.

    Raises:
        SensorTestError: they hold no sensor test.
    """
    names = (*_FIELDS, "return_to_zero")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            values: Mapping[str, Any] = loadmat(BytesIO(data), variable_names=names)
    except _DAMAGE as error:
        raise SensorTestError(
            f"no whole MAT file ({type(error).__name__}); right is one of Matlab 4 to 7.2 with a variable dv"
        ) from error
    dv = _matrix(values)
    text = _text(values, "dlgstr")
    times = values.get("times")
    if times is None:
        rows_at = np.full(len(dv), np.nan)
    else:
        rows_at = _numbers(times, "times").reshape(-1)
        if len(rows_at) != len(dv):
            raise SensorTestError(f"times: {len(rows_at)} values; right are {len(dv)}, as many as rows in dv")
    return SensorRun(_test(values, dv, what), dv, rows_at, text)


def _matrix(values: Mapping[str, Any]) -> NDArray[np.int64]:
    if "dv" not in values:
        raise SensorTestError("no variable dv; right is a matrix of two counters and eight sensors a row")
    dv = _numbers(values["dv"], "dv")
    if dv.ndim != 2 or dv.shape[1] != 10 or not len(dv):
        shape = " x ".join(map(str, dv.shape))
        raise SensorTestError(f"dv: is {shape}; right are rows of 10, two counters and eight sensors")
    wrong = ~np.isfinite(dv) | (np.abs(dv) > 2**31) | (dv != np.floor(dv))
    if wrong.any():
        row, column = (int(place[0]) for place in np.nonzero(wrong))
        raise SensorTestError(f"dv({row + 1},{column + 1}) = {dv[row, column]}: right is a whole number")
    return dv.astype(np.int64)


def _test(values: Mapping[str, Any], dv: NDArray[np.int64], what: What | None) -> SensorTest:
    told = _text(values, "what")
    if told and told != "proximity" and told != "light":
        raise SensorTestError(f"what = {told[:40]!r}: right is proximity or light")
    sensors: What = "light" if told == "light" or (not told and what == "light") else "proximity"
    if "linear_cm" not in values and "rotate_deg" not in values:
        return _guessed(sensors, dv)
    numbers = {
        name: float(_numbers(values[name], name).reshape(-1)[0])
        for name in ("linear_cm", "rotate_deg", "speed", "acceleration", "return_to_zero")
        if name in values and np.size(values[name]) == 1
    }
    for name in ("speed", "acceleration", "return_to_zero"):
        if not numbers.get(name, 0.5).is_integer():
            raise SensorTestError(f"{name} is missing or no whole number; right is a whole number")
    return SensorTest(
        sensors,
        numbers.get("linear_cm"),
        numbers.get("rotate_deg"),
        int(numbers["speed"]),
        int(numbers["acceleration"]),
        bool(numbers["return_to_zero"]),
    )


def _guessed(what: What, dv: NDArray[np.int64]) -> SensorTest:
    """The test that the counters tell of."""
    left, right = (int(count) for count in dv[-1, :2])
    straight, turn = (left + right) / 2 / PULSES_PER_CM, (right - left) / 2 / PULSES_PER_DEGREE
    if left == right == 0:
        raise SensorTestError("dv: the counters end at 0; right is a robot that has moved")
    if left * right < 0:
        return SensorTest(what, rotate_deg=float(np.copysign(np.clip(abs(turn), 15, 360), turn)))
    return SensorTest(what, linear_cm=float(np.copysign(np.clip(abs(straight), 5, 60), straight)))


def _numbers(value: Any, name: str) -> NDArray[np.float64]:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
        raise SensorTestError(f"{name}: are no real numbers; right is a matrix of them")
    return value.astype(np.float64)


def _text(values: Mapping[str, Any], name: str) -> str:
    """A char matrix as lines; of characters that no line has, a space is left."""
    rows = values.get(name)
    if rows is None:
        return ""
    if not isinstance(rows, np.ndarray) or rows.dtype.kind != "U":
        raise SensorTestError(f"{name}: is no text; right is a char matrix")
    lines = [str(row) for row in rows.reshape(-1)]
    # Matlab fills the rows of a matrix up with spaces.
    text = "\n".join(line.rstrip() for line in lines) if len(lines) > 1 else "".join(lines)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(each if each.isprintable() or each in "\n\t" else " " for each in text)
