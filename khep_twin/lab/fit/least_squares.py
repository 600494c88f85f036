"""Least squares with confidence intervals, and a refusal of data that cannot tell a parameter."""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from khep_twin.errors import FitError

Floats = NDArray[np.float64]

CONFIDENCE = 1.96
"""Standard deviations in half of a 95 % confidence interval."""

_UNTOLD = 1e-9
"""Of the best-told combination of parameters: one that is told so little is not told at all."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Something to be found.

    Attributes:
        name: what to call it in messages.
        start: where the search begins.
        scale: by how much it may sensibly differ from there.
        widest: half a confidence interval beyond which the data do not tell it.
        unit: of all three, for messages.
        low: least value.
        high: largest value.
    """

    name: str
    start: float
    scale: float
    widest: float
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True, slots=True)
class Estimate:
    """What was found.

    Attributes:
        values: of the parameters, in order.
        intervals: half the width of each one's 95 % confidence interval.
        rms: root mean square of what is left.
    """

    values: tuple[float, ...]
    intervals: tuple[float, ...]
    rms: float


def estimate(
    residuals: Callable[[Floats], Floats],
    parameters: Sequence[Parameter],
    wish: str,
    loss: Literal["linear", "soft_l1"] = "linear",
    f_scale: float = 1.0,
    step: float = 1e-4,
    unit_variance: bool = False,
) -> Estimate:
    """Finds the parameters that leave the least over.

    Args:
        residuals: what parameters (n,) leave over (m,).
        parameters: to be found.
        wish: which data would tell them, for messages.
        loss: of scipy's least_squares; "soft_l1" lets a few wild readings count less.
        f_scale: residual from which on a reading counts as wild.
        unit_variance: whether residuals are told in their own standard deviations; then what is left is taken
            as noise only where it is more than that.
        step: in each parameter's scale, over which slopes are taken.

    Raises:
        FitError: the data cannot tell a parameter.
    """
    scales = np.array([parameter.scale for parameter in parameters])
    start = np.array([parameter.start for parameter in parameters])
    low = (np.array([parameter.low for parameter in parameters]) - start) / scales
    high = (np.array([parameter.high for parameter in parameters]) - start) / scales

    def scaled(x: Floats) -> Floats:
        return residuals(start + x * scales)

    def slopes(x: Floats) -> Floats:
        ways = np.eye(len(x)) * step
        return np.column_stack([(scaled(x + way) - scaled(x - way)) / (2 * step) for way in ways])

    found = least_squares(
        scaled,
        np.zeros(len(start)),
        jac=slopes,  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        loss=loss,
        f_scale=f_scale,
    )
    left = scaled(found.x)
    rms = float(np.sqrt(np.mean(left**2)))
    noise = max(rms, 1.0) if unit_variance else rms
    intervals = CONFIDENCE * noise * scales * np.sqrt(_variances(found.jac, parameters, wish))
    for parameter, interval in zip(parameters, intervals, strict=True):
        if not interval <= parameter.widest:
            raise FitError(
                f"{parameter.name}: cannot be told better than to +-{interval:.3g}{parameter.unit}; "
                f"right are {wish}"
            )
    return Estimate(tuple((start + found.x * scales).tolist()), tuple(intervals.tolist()), rms)


def _variances(slopes: Floats, parameters: Sequence[Parameter], wish: str) -> Floats:
    """Of the parameters, for residuals of variance 1."""
    _, strengths, ways = np.linalg.svd(slopes, full_matrices=False)
    if not strengths[-1] > _UNTOLD * strengths[0]:
        worst = parameters[int(np.abs(ways[-1]).argmax())]
        raise FitError(f"{worst.name}: cannot be told at all; right are {wish}")
    return ((ways / strengths[:, None]) ** 2).sum(axis=0)
