"""Least squares with priors and confidence intervals; data that do not determine a parameter are refused.

A parameter with a prior, such as the error of a ruler, is one more unknown x with one more residual
(x - start) / prior. So the intervals of the others contain what its error may do to them:

    C = (J^T J + diag(1 / prior^2))^-1,  interval = 1.96 noise sqrt(diag C)

A parameter that the data do not determine better than its prior does is held at its start; the others'
intervals contain then what its deviation may do to them.

A noisy reading that is clipped at both ends still informs: near an end its mean tells the level x.

    E[clip(x + s z, 0, limit)],  z normal
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
# pyright: reportUnknownArgumentType=false

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from khep_twin.errors import FitError

Floats = NDArray[np.float64]

CONFIDENCE = 1.96
"""Standard deviations in half of a 95 % confidence interval."""

DETERMINED = 0.5
"""Largest standard deviation of a parameter after a fit, of that before it, for which its value is taken."""

_UNTOLD = 1e-14
"""Smallest eigenvalue of the normal equations that determines a combination of parameters, relative to the
largest."""

_ITERATIONS, _PRECISION, _STUCK = 200, 1e-9, 1e9
"""Most iterations, smallest relative progress of one, and damping at which there is none."""


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
        prior: Standard deviation of the value around `start` before the fit; inf if nothing is known.
        optional: True to hold the value at `start` where the data do not determine it.
    """

    name: str
    start: float
    scale: float
    widest: float = np.inf
    unit: str = ""
    low: float = -np.inf
    high: float = np.inf
    prior: float = np.inf
    optional: bool = False


@dataclass(frozen=True, slots=True)
class Estimate:
    """Fitted parameters.

    Attributes:
        values: Values of the parameters, in order (n,).
        intervals: Halves of their 95 % confidence intervals (n,).
        rms: Root mean square of the residuals.
        held: True for those that were held at their start (n,).
    """

    values: Floats
    intervals: Floats
    rms: float
    held: NDArray[np.bool_]


def least_squares(
    residuals: Callable[[Floats], Floats],
    parameters: Sequence[Parameter],
    wanted: str,
    outlier: float = math.inf,
    step: float = 1e-4,
    unit_variance: bool = False,
    owners: NDArray[np.int64] | None = None,
) -> Estimate:
    """Fit parameters by least squares.

    Args:
        residuals: Function of the parameters (n,) that returns the residuals (m,).
        parameters: Parameters to fit. With priors, the residuals must be in their standard deviation.
        wanted: Data that would determine them, for messages.
        outlier: Residual from which on a reading counts as an outlier, which has less weight.
        unit_variance: If true, residuals are in units of their standard deviation, and the noise is
            estimated from their root mean square only if that is larger.
        step: Step of the numeric derivatives, in each parameter's scale.
        owners: Parameters that each residual depends on (m, k), the same parameter always in the same
            column; then k derivatives are computed at a time. None if each depends on all.

    Raises:
        FitError: The data do not determine a parameter.
    """
    problem = _Problem(residuals, parameters, step, owners)
    held = np.zeros(len(parameters), np.bool_)
    values = problem.solve(held, outlier)
    variances = problem.variances(values, held, wanted)
    left = residuals(values)
    rms = float(np.sqrt(np.mean(left**2)))
    noise = max(rms, 1.0) if unit_variance else rms
    priors = np.array([parameter.prior for parameter in parameters])
    may_be_held = np.array([parameter.optional for parameter in parameters])
    held = may_be_held & (noise * np.sqrt(variances) > DETERMINED * priors)
    if held.any():
        values = problem.solve(held, outlier)
        variances = problem.variances(values, held, wanted)
        rms = float(np.sqrt(np.mean(residuals(values) ** 2)))
        noise = max(rms, 1.0) if unit_variance else rms
    intervals = CONFIDENCE * noise * np.sqrt(variances)
    for parameter, interval in zip(parameters, intervals, strict=True):
        if not interval <= parameter.widest:
            found_to = f"can be determined to +-{interval:.3g}{parameter.unit} only"
            raise FitError(f"{parameter.name}: {found_to}; expected {wanted}")
    return Estimate(values, intervals, rms, held)


class _Problem:
    """Residuals and priors as functions of scaled parameters, of which some are held."""

    def __init__(
        self,
        residuals: Callable[[Floats], Floats],
        parameters: Sequence[Parameter],
        step: float,
        owners: NDArray[np.int64] | None,
    ) -> None:
        self._residuals, self._parameters, self._step, self._owners = residuals, parameters, step, owners
        self._start = np.array([parameter.start for parameter in parameters])
        self._scales = np.array([parameter.scale for parameter in parameters])
        low, high = np.array([(parameter.low, parameter.high) for parameter in parameters]).T
        self._low, self._high = (low - self._start) / self._scales, (high - self._start) / self._scales
        self._pulls = self._scales / np.array([parameter.prior for parameter in parameters])

    def solve(self, held: NDArray[np.bool_], outlier: float) -> Floats:
        """Return the best values, by the method of Levenberg and Marquardt."""
        x = np.zeros(len(held))
        left, damping = self._scaled(x), 1e-3
        cost = self._cost(x, left, outlier)
        for _ in range(_ITERATIONS):
            bends, downhill = self._normal(x, left, 1 / np.sqrt(1 + (left / outlier) ** 2))
            at_a_bound = ((x <= self._low) & (downhill < 0)) | ((x >= self._high) & (downhill > 0))
            free = np.flatnonzero(~held & ~at_a_bound)
            bends, before = bends[np.ix_(free, free)], cost
            while damping < _STUCK:
                damped = bends + damping * np.diag(np.maximum(np.diag(bends), _UNTOLD))
                new = x.copy()
                new[free] += np.linalg.solve(damped, downhill[free])
                new = np.clip(new, self._low, self._high)
                new_left = self._scaled(new)
                new_cost = self._cost(new, new_left, outlier)
                if new_cost < cost:
                    x, left, cost, damping = new, new_left, new_cost, damping / 10
                    break
                damping *= 10
            if before - cost <= _PRECISION * before:
                break
        return self._start + x * self._scales

    def _cost(self, x: Floats, left: Floats, outlier: float) -> float:
        """Return the sum of the losses, soft_l1 of scipy's, and of the squared priors."""
        ratios = left / outlier
        loss = left**2 if math.isinf(outlier) else 2 * outlier**2 * (np.sqrt(1 + ratios**2) - 1)
        return float(loss.sum() + ((self._pulls * x) ** 2).sum())

    def variances(self, values: Floats, held: NDArray[np.bool_], wanted: str) -> Floats:
        """Return the variances of the parameters, for residuals of variance 1."""
        x = (values - self._start) / self._scales
        bends, _ = self._normal(x, self._scaled(x), np.ones(1))
        free = np.flatnonzero(~held)
        strengths, directions = np.linalg.eigh(bends[np.ix_(free, free)])
        if not strengths[0] > _UNTOLD * strengths[-1]:
            worst = self._parameters[int(free[np.abs(directions[:, 0]).argmax()])]
            raise FitError(f"{worst.name}: cannot be determined; expected {wanted}")
        covariance = (directions / strengths) @ directions.T
        # A deviation of a held parameter moves the others' best values.
        moved = covariance @ bends[np.ix_(free, np.flatnonzero(held))] / self._pulls[held]
        variances = np.zeros(len(values))
        variances[free] = np.diag(covariance) + (moved**2).sum(axis=1)
        variances[held] = 1 / self._pulls[held] ** 2
        return variances * self._scales**2

    def _normal(self, x: Floats, left: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """Return the matrix of the normal equations (n, n) and their right side (n,), priors included."""
        n, penalty = len(x), np.diag(self._pulls**2)
        if self._owners is None:
            slopes = np.column_stack([self._slope(x, direction) for direction in np.eye(n) * self._step])
            weighted = slopes * weights[:, None]
            return weighted.T @ slopes + penalty, -(weighted.T @ left + self._pulls**2 * x)
        steps = np.full(n, self._step)
        slopes = [self._slope(x, np.where(np.isin(np.arange(n), own), steps, 0)) for own in self._owners.T]
        bends, downhill = penalty.ravel(), -(self._pulls**2) * x
        for own, slope in zip(self._owners.T, slopes, strict=True):
            downhill -= np.bincount(own, slope * weights * left, n)
            for other, across in zip(self._owners.T, slopes, strict=True):
                bends = bends + np.bincount(own * n + other, slope * weights * across, n * n)
        return bends.reshape(n, n), downhill

    def _scaled(self, x: Floats) -> Floats:
        return self._residuals(self._start + x * self._scales)

    def _slope(self, x: Floats, way: Floats) -> Floats:
        return (self._scaled(x + way) - self._scaled(x - way)) / (2 * self._step)


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
