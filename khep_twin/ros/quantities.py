"""Units of channels, as factors to the units of ROS messages (REP 103)."""

import math
import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from khep_twin.robots.model import RobotModel

_FACTORS = {
    "m/s^2": 1.0, "g": 9.80665, "rad/s": 1.0, "deg/s": math.radians(1),
    "V": 1.0, "mV": 1e-3, "A": 1.0, "mA": 1e-3, "Ah": 1.0, "mAh": 1e-3, "degree C": 1.0,
}  # fmt: skip
"""Factors of units; ROS has charges in Ah and temperatures in degrees Celsius."""

_UNIT = re.compile(r"(?:(?P<number>[\d.]+)(?:/(?P<divisor>[\d.]+))? )?(?P<symbol>.+)")


def factor_of(unit: str) -> float | None:
    """Return the factor of a unit, e.g. of "1/16384 g" or "0.066 deg/s"; None for an unknown one."""
    match = _UNIT.fullmatch(unit)
    if match is None or match["symbol"] not in _FACTORS:
        return None
    return float(match["number"] or 1) / float(match["divisor"] or 1) * _FACTORS[match["symbol"]]


def columns_of(
    model: RobotModel, channel: str, channels: Mapping[str, NDArray[np.generic]]
) -> dict[str, NDArray[np.float64]]:
    """Return the columns of a channel with known units by their names, e.g. "x" of "accelerometer_x"."""
    values, columns = channels.get(channel), model.channels.get(channel, ())
    if values is None or values.shape[1] != len(columns):
        return {}
    return {
        name.removeprefix(f"{channel}_"): factor * values[:, index].astype(np.float64)
        for index, (name, unit) in enumerate(columns)
        if (factor := factor_of(unit)) is not None
    }
