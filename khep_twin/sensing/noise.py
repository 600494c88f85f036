"""Noise of the sensors, and the random draws behind it: a counter-based generator, and quantiles.

Three functions make the noise of a conversion from its draws: `proximity_noise`, `ambient_noise` and
`idle_counts`; another model of noise is another body of theirs. Their numbers are of the robot's calibration.

The draws of a conversion follow from a robot's key and the number of the conversion alone: nothing is kept
between two conversions, and any of them can be drawn first. The generator is Philox-2x32-10 (Salmon, Moraes,
Dror and Shaw, 2011). Its 64 bits make three draws: two normal ones and an exponential one, by straight lines
between quantiles, so that the same source gives the same bits interpreted and compiled.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

from khep_twin.compilable import compilable
from khep_twin.sensing.buffers import Vector
from khep_twin.sensing.robot_sensors import Ambient, Proximity

Draws = tuple[float, float, float]
"""Random draws of a conversion for proximity, ambient and idle counts: the first two with mean 0 and standard
deviation 1, the third with mean 1."""

N_CELLS = 1024
"""Cells of equal probability between two quantiles."""

Tables = Sequence[Sequence[float]]
"""Quantiles of the normal and of the exponential distribution (2, N_CELLS + 1); all 0 for no noise."""

_BITS, _PART_BITS = 10, 11
"""Bits of a draw that choose its cell, and bits of its place in it."""
_CELL, _PLACE, _PART = (1 << _BITS) - 1, (1 << _PART_BITS) - 1, 1 / (1 << _PART_BITS)

_ROUNDS, _MULTIPLIER, _KEY_STEP = 10, 0xD256D193, 0x9E3779B9
"""Constants of Philox-2x32-10."""

_WORD = 0xFFFFFFFF


def key_words(key: int) -> tuple[int, int]:
    """Return a key of 64 bits as the two words that `draws` takes."""
    return key & _WORD, key >> 32


def quantiles() -> list[list[float]]:
    """Return the quantiles of both distributions.

    The cells at their ends have the distribution's mean there, so that the largest normal draw is 3.65 and
    the largest exponential one 8.93.
    """
    normal = NormalDist()
    edges = [normal.inv_cdf(cell / N_CELLS) for cell in range(1, N_CELLS)]
    last = 2 * normal.pdf(edges[-1]) * N_CELLS - edges[-1]
    falling = [-math.log1p(-cell / N_CELLS) for cell in range(N_CELLS)]
    return [[-last, *edges, last], [*falling, falling[-1] + 2]]


def no_noise() -> list[list[float]]:
    """Return tables whose draws are all 0."""
    return [[0.0] * (N_CELLS + 1) for _ in range(2)]


TABLES = no_noise(), quantiles()
"""Tables for `draws` without noise and with it, by whether there is any."""

TABLE_ARRAYS = tuple(np.array(tables) for tables in TABLES)
"""The same for compiled code (2, N_CELLS + 1)."""


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
    """Return the reading of reflected light with nothing in reach [counts]."""
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
    # Two draws have the lowest 21 bits of a word each; the third has what is left of both.
    rest = (low >> 21 << 10) | (high >> 22)
    return _quantile(tables[0], low), _quantile(tables[0], high), _quantile(tables[1], rest)


@compilable
def philox(low: int, high: int, key: int) -> tuple[int, int]:
    """Return the two words that belong to a counter of two words and a key of one."""
    for _ in range(_ROUNDS):
        # Compiled code wraps the product to 64 bits with a sign, which the masks take off.
        product = _MULTIPLIER * low
        low, high = ((product >> 32) & _WORD) ^ key ^ high, product & _WORD
        key = (key + _KEY_STEP) & _WORD
    return low, high


@compilable
def _quantile(table: Sequence[float], bits: int) -> float:
    """Return the quantile at the lowest bits of a number."""
    cell = (bits >> _PART_BITS) & _CELL
    low = table[cell]
    return low + (table[cell + 1] - low) * ((bits & _PLACE) * _PART)
