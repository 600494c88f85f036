"""Lobes of infrared sensors: their norm and width, and tables of the light from faces."""

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise

N_CELLS = 256
"""Cells of a table, over the sine of the azimuth from -1 to 1."""

FOOT = 3
"""Exponent of the cosine off the foot in the light from a face."""

_NODES = (
    (-0.8611363115940526, 0.3478548451374538),
    (-0.3399810435848563, 0.6521451548625461),
    (0.3399810435848563, 0.6521451548625461),
    (0.8611363115940526, 0.3478548451374538),
)
"""Nodes and weights of Gauss and Legendre's quadrature."""


def norm(exponent: float) -> float:
    """Return N of `reflection`: the integral of lobe(theta) cos(theta)^3 over the azimuth."""
    return _mean(exponent, lambda n: _power(n + FOOT))


def width(exponent: float) -> float:
    """Return the integral of lobe(theta) over the azimuth [rad]."""
    return _mean(exponent, _power)


@cache
def table(exponent: float) -> list[list[float]]:
    """Return the light of faces cumulated over the azimuth theta (N_CELLS + 1, 4).

    The columns have the integrals of lobe cos^(3 - j) sin^j, over the norm: with the cosine and sine of a
    foot's direction, they add up to the light of any face.

    Args:
        exponent: Exponent of the lobe; between whole ones, it is their weighted mean.
    """
    whole, scale = int(exponent), 1 / norm(exponent)
    rows = [[0.0] * (FOOT + 1)]
    edges = [math.asin(2 * cell / N_CELLS - 1) for cell in range(N_CELLS + 1)]
    for low, high in pairwise(edges):
        row, half = rows[-1].copy(), (high - low) / 2
        for node, weight in _NODES:
            azimuth = low + half * (1 + node)
            cosine, sine = math.cos(azimuth), math.sin(azimuth)
            lobe = cosine**whole * (1 - (exponent - whole) * (1 - cosine)) * weight * half * scale
            for j in range(FOOT + 1):
                row[j] += lobe * cosine ** (FOOT - j) * sine**j
        rows.append(row)
    return rows


def _mean(exponent: float, integral: Callable[[int], float]) -> float:
    whole = int(exponent)
    part = exponent - whole
    return (1 - part) * integral(whole) + part * integral(whole + 1)


def _power(n: int) -> float:
    """Return the integral of cos(theta)^n from -pi/2 to pi/2."""
    return math.sqrt(math.pi) * math.gamma((n + 1) / 2) / math.gamma(n / 2 + 1)
