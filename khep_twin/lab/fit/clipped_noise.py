"""Mean and standard deviation of a noisy reading that is clipped at both ends.

    E[clip(x + s z, 0, limit)],  z normal

A clipped reading still carries information: near an end its mean tells the level x.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import numpy as np
from scipy.special import ndtr

from khep_twin.lab.fit.least_squares import Floats


def expected(levels: Floats, noise: float | Floats, limit: float) -> Floats:
    """Return the mean reading of a noisy sensor that is clipped to 0 and a limit."""
    noise = np.maximum(noise, 1e-6)
    low, high = -levels / noise, (limit - levels) / noise
    return noise * (_bell(low) - _bell(high)) + levels * (ndtr(high) - ndtr(low)) + limit * ndtr(-high)


def deviation(levels: Floats, noise: float | Floats, limit: float) -> Floats:
    """Return the standard deviation of such a reading, which is small where it is clipped."""
    noise = np.maximum(noise, 1e-6)
    low, high = -levels / noise, (limit - levels) / noise
    inside = ndtr(high) - ndtr(low)
    squares = (
        (levels**2 + noise**2) * inside
        + 2 * levels * noise * (_bell(low) - _bell(high))
        + noise**2 * (low * _bell(low) - high * _bell(high))
        + limit**2 * ndtr(-high)
    )
    return np.sqrt(np.maximum(squares - expected(levels, noise, limit) ** 2, 0))


def _bell(z: Floats) -> Floats:
    return np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
