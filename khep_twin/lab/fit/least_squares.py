"""Least squares with confidence intervals; data that do not determine a parameter are refused."""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from khep_twin.errors import FitError

Floats = NDArray[np.float64]

CONFIDENCE = 1.96
"""Standard deviations in half of a 95 % confidence interval."""

_UNTOLD = 1e-9
"""Smallest singular value that determines a combination of parameters, relative to the largest."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter to be fitted.

    Attributes:
        name: Name in messages.
        start: Initial value.
        scale: Typical difference from the initial value.
        widest: Largest half of the confidence interval that is accepted.
        unit: Unit of these values, for messages.
        low: Lower bound.
        high: Upper bound.
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
    """Fitted parameters.

    Attributes:
        values: Values of the parameters, in order.
        intervals: Halves of their 95 % confidence intervals.
        rms: Root mean square of the residuals.
    """

    values: tuple[float, ...]
    intervals: tuple[float, ...]
    rms: float


def least_squares(
    residuals: Callable[[Floats], Floats],
    parameters: Sequence[Parameter],
    wanted: str,
    loss: Literal["linear", "soft_l1"] = "linear",
    f_scale: float = 1.0,
    step: float = 1e-4,
    unit_variance: bool = False,
) -> Estimate:
    """Fit parameters by least squares.

    Args:
        residuals: Function of the parameters (n,) that returns the residuals (m,).
        parameters: Parameters to fit.
        wanted: Data that would determine them, for messages.
        loss: Loss of scipy's least_squares; "soft_l1" reduces the weight of outliers.
        f_scale: Residual from which on a reading counts as an outlier.
        unit_variance: If true, residuals are in units of their own standard deviation, and the noise is
            estimated from their root mean square only if that is larger.
        step: Step of the numeric derivatives, in each parameter's scale.

    Raises:
        FitError: The data do not determine a parameter.
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

    first, jac = np.zeros(len(start)), cast(Any, slopes)
    found = optimize.least_squares(scaled, first, jac, (low, high), loss=loss, f_scale=f_scale)
    left = scaled(found.x)
    rms = float(np.sqrt(np.mean(left**2)))
    noise = max(rms, 1.0) if unit_variance else rms
    intervals = CONFIDENCE * noise * scales * np.sqrt(_variances(found.jac, parameters, wanted))
    for parameter, interval in zip(parameters, intervals, strict=True):
        if not interval <= parameter.widest:
            found_to = f"can be determined to +-{interval:.3g}{parameter.unit} only"
            raise FitError(f"{parameter.name}: {found_to}; expected {wanted}")
    return Estimate(tuple((start + found.x * scales).tolist()), tuple(intervals.tolist()), rms)


def _variances(slopes: Floats, parameters: Sequence[Parameter], wanted: str) -> Floats:
    """Return the variances of the parameters, for residuals of variance 1."""
    _, strengths, ways = np.linalg.svd(slopes, full_matrices=False)
    if not strengths[-1] > _UNTOLD * strengths[0]:
        worst = parameters[int(np.abs(ways[-1]).argmax())]
        raise FitError(f"{worst.name}: cannot be determined; expected {wanted}")
    return ((ways / strengths[:, None]) ** 2).sum(axis=0)
