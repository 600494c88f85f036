"""Lobes of infrared sensors, cos(azimuth)^exponent: norm, width, and tables of the light from faces."""

import math
from collections.abc import Callable
from functools import cache
from itertools import pairwise

N_CELLS = 256
"""Cells of a table, over the sine of the azimuth from -1 to 1."""

FOOT_EXPONENT = 3
"""Exponent of the cosine of the angle from a face's foot, its nearest point, in the light from it."""

_NODES = (
    (-0.8611363115940526, 0.3478548451374538),
    (-0.3399810435848563, 0.6521451548625461),
    (0.3399810435848563, 0.6521451548625461),
    (0.8611363115940526, 0.3478548451374538),
)
"""Nodes and weights of the Gauss-Legendre quadrature."""


def norm(exponent: float) -> float:
    """Return N of `reflection`: the integral of lobe(theta) cos(theta)^3 over the azimuth."""
    return _interpolate(exponent, lambda n: _cosine_integral(n + FOOT_EXPONENT))


def width(exponent: float) -> float:
    """Return the integral of lobe(theta) over the azimuth [rad]."""
    return _interpolate(exponent, _cosine_integral)


@cache
def table(exponent: float) -> list[list[float]]:
    """Return the cumulative light of faces over the azimuth theta (N_CELLS + 1, 4).

    Column j is the integral of lobe cos^(3 - j) sin^j, divided by the norm. The light of a face is a sum of
    the columns, weighted by cosine and sine of the direction of its foot. A fractional exponent interpolates
    between two integers.
    """
    integer, scale = int(exponent), 1 / norm(exponent)
    rows = [[0.0] * (FOOT_EXPONENT + 1)]
    edges = [math.asin(2 * cell / N_CELLS - 1) for cell in range(N_CELLS + 1)]
    for low, high in pairwise(edges):
        row, half_width = rows[-1].copy(), (high - low) / 2
        for node, weight in _NODES:
            azimuth = low + half_width * (1 + node)
            cosine, sine = math.cos(azimuth), math.sin(azimuth)
            lobe = cosine**integer * (1 - (exponent - integer) * (1 - cosine)) * weight * half_width * scale
            for j in range(FOOT_EXPONENT + 1):
                row[j] += lobe * cosine ** (FOOT_EXPONENT - j) * sine**j
        rows.append(row)
    return rows


def _interpolate(exponent: float, integral_of: Callable[[int], float]) -> float:
    """Return an integral that is known for integer exponents, linearly interpolated between two of them."""
    integer = int(exponent)
    fraction = exponent - integer
    return (1 - fraction) * integral_of(integer) + fraction * integral_of(integer + 1)


def _cosine_integral(n: int) -> float:
    """Return the integral of cos(theta)^n from -pi/2 to pi/2."""
    return math.sqrt(math.pi) * math.gamma((n + 1) / 2) / math.gamma(n / 2 + 1)
