"""Noise of the sensors, and the random draws behind it: a counter-based generator, and quantiles.

Three functions compute the noise of a conversion from its draws and the robot's calibration:
`proximity_noise`, `ambient_noise` and `idle_counts`. Replace their bodies for another model of noise. A run
may scale all of the noise: True is a scale of 1, the calibrated noise, and False is 0, none.

The draws of a conversion depend only on a robot's key and the number of the conversion: the generator has no
state, and conversions may be drawn in any order. The generator is Philox-2x32-10 (Salmon, Moraes,
Dror and Shaw, 2011). The 64 bits of one call give three draws, two normal and one exponential, by linear
interpolation between quantiles; plain and compiled code give the same values, bit for bit.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from numbers import Real
from statistics import NormalDist
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from khep_twin.compilable import compilable
from khep_twin.errors import value_text
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import Ambient, Proximity

Draws = tuple[float, float, float]
"""Random draws of a conversion for proximity, ambient light and idle counts: two with mean 0 and standard
deviation 1, one with mean 1."""

N_CELLS = 1024
"""Cells of equal probability between two quantiles."""

Tables = Sequence[Sequence[float]]
"""Quantiles of the normal and of the exponential distribution, times a scale (2, N_CELLS + 1)."""

MAX_SCALE = 100
"""Largest scale of the noise (assumed)."""

Scale = Annotated[float, Field(ge=0, le=MAX_SCALE)]
"""Scale of the noise, a factor of its standard deviations."""

_BITS, _POSITION_BITS = 10, 11
"""Bits of a draw that choose its cell, and bits of its position in the cell."""
_CELL_MASK, _POSITION_MASK, _POSITION_SCALE = (1 << _BITS) - 1, (1 << _POSITION_BITS) - 1, 2**-_POSITION_BITS

_ROUNDS, _MULTIPLIER, _KEY_STEP = 10, 0xD256D193, 0x9E3779B9
"""Constants of Philox-2x32-10."""

_WORD = 0xFFFFFFFF


def key_words(key: int) -> tuple[int, int]:
    """Return a 64-bit key as the two words that `draws` requires."""
    return key & _WORD, key >> 32


def check_scale(noise: object) -> float:
    """Return a scale of the noise as a number: 1 for True, 0 for False.

    Raises:
        ValueError: It is neither True, False nor a number in range.
    """
    scale: Any = noise
    if isinstance(noise, Real | np.bool_) and 0 <= scale <= MAX_SCALE:
        return float(scale)
    raise ValueError(f"noise = {value_text(scale)}; expected True, False, or a scale from 0 to {MAX_SCALE}")


def quantiles() -> list[list[float]]:
    """Return the quantiles of both distributions.

    The outermost cells have the mean of the distribution's tail, so that the largest normal draw is 3.65
    and the largest exponential one 8.93.
    """
    normal = NormalDist()
    edges = [normal.inv_cdf(cell / N_CELLS) for cell in range(1, N_CELLS)]
    extreme = 2 * normal.pdf(edges[-1]) * N_CELLS - edges[-1]
    exponential = [-math.log1p(-cell / N_CELLS) for cell in range(N_CELLS)]
    return [[-extreme, *edges, extreme], [*exponential, exponential[-1] + 2]]


@lru_cache(maxsize=64)
def compiled_tables(scale: float) -> NDArray[np.float64]:
    """Return the tables of `draws` for a scale of the noise, for compiled code (2, N_CELLS + 1)."""
    return scale * np.array(quantiles())


@lru_cache(maxsize=64)
def plain_tables(scale: float) -> list[list[float]]:
    """Return the same tables for plain code."""
    return compiled_tables(scale).tolist()


@compilable
def proximity_noise(proximity: Proximity, channel: int, draws: Draws) -> float:
    """Return the noise of one reading of reflected light [counts]."""
    return proximity.noise[channel] * draws[0]


@compilable
def ambient_noise(ambient: Ambient, draws: Draws) -> float:
    """Return the noise of one reading of ambient light [counts]."""
    return ambient.noise * draws[1]


@compilable
def idle_counts(proximity: Proximity, draws: Draws) -> int:
    """Return the reading of reflected light with nothing in range [counts]."""
    return int(proximity.idle * draws[2])


@compilable
def draws(tables: Tables, key: Vector[int], number: int) -> Draws:
    """Return the draws of a conversion.

    Args:
        tables: Quantiles of the distributions.
        key: Words of the robot's key (2,).
        number: Number of the conversion.
    """
    low, high = philox(number & _WORD, (key[1] + (number >> 32)) & _WORD, key[0])
    # Two draws use the lowest 21 bits of one word each; the third uses the highest bits of both.
    top_bits = (low >> 21 << 10) | (high >> 22)
    return _quantile(tables[0], low), _quantile(tables[0], high), _quantile(tables[1], top_bits)


@compilable
def philox(low: int, high: int, key: int) -> tuple[int, int]:
    """Return the two random words of a two-word counter and a one-word key."""
    for _ in range(_ROUNDS):
        # Compiled code wraps the product to a signed 64-bit integer; the masks remove the sign.
        product = _MULTIPLIER * low
        low, high = ((product >> 32) & _WORD) ^ key ^ high, product & _WORD
        key = (key + _KEY_STEP) & _WORD
    return low, high


@compilable
def _quantile(table: Sequence[float], bits: int) -> float:
    """Return the quantile selected by the lowest bits of a number."""
    cell = (bits >> _POSITION_BITS) & _CELL_MASK
    low = table[cell]
    return low + (table[cell + 1] - low) * ((bits & _POSITION_MASK) * _POSITION_SCALE)
