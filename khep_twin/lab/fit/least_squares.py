"""Least squares with priors and confidence intervals; an error if data do not determine a parameter.

A parameter with a prior, for example the error of a ruler, is an additional unknown x with an additional
residual (x - start) / prior. Its uncertainty propagates to the intervals of the other parameters:

    C = (J^T J + diag(1 / prior^2))^-1,  interval = 1.96 noise sqrt(diag C)

Here C is the covariance for residuals of variance 1, and J the Jacobian of the residuals. An optional
parameter is fixed at its initial value if the data do not determine it better than its prior. The uncertainty
of that value also propagates to the other intervals.

Readings are clipped to 0 and a limit. Near an end, the mean of a noisy one still depends on the level x:

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
"""Half width of a 95 % confidence interval, in standard deviations."""

MAX_DEVIATION_RATIO = 0.5
"""Largest ratio of a parameter's standard deviations after and before a fit at which its value is used."""

_MIN_EIGENVALUE = 1e-14
"""Smallest eigenvalue of the normal equations, relative to the largest, for which they are regular."""
_MAX_ITERATIONS, _TOLERANCE, _MAX_DAMPING = 200, 1e-9, 1e9
"""Limits of the iterations, of their relative progress, and of the damping, beyond which they stop."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """Parameter to fit.

    Attributes:
        name: Name in messages.
        start: Initial value.
        scale: Typical difference from the initial value.
        max_interval: Largest accepted half width of the confidence interval.
        unit: Unit of these values, for messages.
        low: Lower bound.
        high: Upper bound.
        prior: Standard deviation of the value around `start` before the fit; inf without a prior.
        optional: True to fix the value at `start` if the data do not determine it.
    """

    name: str
    start: float
    scale: float
    max_interval: float = np.inf
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
        intervals: Half widths of their 95 % confidence intervals (n,).
        rms: Root mean square of the residuals.
        fixed: True for parameters that were fixed at their initial value (n,).
    """

    values: Floats
    intervals: Floats
    rms: float
    fixed: NDArray[np.bool_]


def least_squares(
    residuals: Callable[[Floats], Floats],
    parameters: Sequence[Parameter],
    expected_data: str,
    outlier: float = math.inf,
    step: float = 1e-4,
    unit_variance: bool = False,
    sparsity: NDArray[np.int64] | None = None,
) -> Estimate:
    """Fit parameters by least squares.

    Args:
        residuals: Function of the parameters (n,) that returns the residuals (m,).
        parameters: Parameters to fit. With priors, the residuals must be in units of standard deviations.
        expected_data: Data that would determine the parameters, for messages.
        outlier: Residual above which a reading is an outlier and loses weight (scale of the robust loss).
        unit_variance: If true, residuals are in units of their standard deviation, and the noise is their
            root mean square only if that is above 1.
        step: Step of the numeric derivatives, in each parameter's scale.
        sparsity: Indices of the parameters on which each residual depends (m, k), each parameter always in
            the same column; then k derivatives are computed at a time. None for a dense Jacobian.

    Raises:
        FitError: The data do not determine a parameter.
    """
    problem = _Problem(residuals, parameters, step, sparsity)
    fixed = np.zeros(len(parameters), np.bool_)
    values = problem.solve(fixed, outlier)
    variances = problem.variances(values, fixed, expected_data)
    rms = float(np.sqrt(np.mean(residuals(values) ** 2)))
    noise = max(rms, 1.0) if unit_variance else rms
    priors = np.array([parameter.prior for parameter in parameters])
    may_be_fixed = np.array([parameter.optional for parameter in parameters])
    fixed = may_be_fixed & (noise * np.sqrt(variances) > MAX_DEVIATION_RATIO * priors)
    if fixed.any():
        values = problem.solve(fixed, outlier)
        variances = problem.variances(values, fixed, expected_data)
        rms = float(np.sqrt(np.mean(residuals(values) ** 2)))
        noise = max(rms, 1.0) if unit_variance else rms
    intervals = CONFIDENCE * noise * np.sqrt(variances)
    for parameter, interval in zip(parameters, intervals, strict=True):
        if not interval <= parameter.max_interval:
            precision_text = f"can be determined to +-{interval:.3g}{parameter.unit} only"
            raise FitError(f"{parameter.name}: {precision_text}; expected {expected_data}")
    return Estimate(values, intervals, rms, fixed)


class _Problem:
    """Residuals and priors as functions of scaled parameters, some of which are fixed."""

    def __init__(
        self,
        residuals: Callable[[Floats], Floats],
        parameters: Sequence[Parameter],
        step: float,
        sparsity: NDArray[np.int64] | None,
    ) -> None:
        self._residuals = residuals
        self._parameters = parameters
        self._step = step
        self._sparsity = sparsity
        self._start = np.array([parameter.start for parameter in parameters])
        self._scales = np.array([parameter.scale for parameter in parameters])
        low, high = np.array([(parameter.low, parameter.high) for parameter in parameters]).T
        self._low, self._high = (low - self._start) / self._scales, (high - self._start) / self._scales
        self._prior_weights = self._scales / np.array([parameter.prior for parameter in parameters])

    def solve(self, fixed: NDArray[np.bool_], outlier: float) -> Floats:
        """Return the values with the least cost, by the Levenberg-Marquardt method."""
        x = np.zeros(len(fixed))
        residuals, damping = self._residuals_at(x), 1e-3
        cost = self._cost(x, residuals, outlier)
        for _ in range(_MAX_ITERATIONS):
            loss_weights = 1 / np.sqrt(1 + (residuals / outlier) ** 2)
            hessian, descent = self._normal_equations(x, residuals, loss_weights)
            is_at_bound = ((x <= self._low) & (descent < 0)) | ((x >= self._high) & (descent > 0))
            free = np.flatnonzero(~fixed & ~is_at_bound)
            hessian, previous_cost = hessian[np.ix_(free, free)], cost
            while damping < _MAX_DAMPING:
                damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), _MIN_EIGENVALUE))
                candidate = x.copy()
                candidate[free] += np.linalg.solve(damped, descent[free])
                candidate = np.clip(candidate, self._low, self._high)
                candidate_residuals = self._residuals_at(candidate)
                candidate_cost = self._cost(candidate, candidate_residuals, outlier)
                if candidate_cost < cost:
                    x, residuals, cost, damping = candidate, candidate_residuals, candidate_cost, damping / 10
                    break
                damping *= 10
            if previous_cost - cost <= _TOLERANCE * previous_cost:
                break
        return self._start + x * self._scales

    def _cost(self, x: Floats, residuals: Floats, outlier: float) -> float:
        """Return the sum of the losses, those of scipy's soft_l1, and of the squared prior residuals."""
        ratios = residuals / outlier
        loss = residuals**2 if math.isinf(outlier) else 2 * outlier**2 * (np.sqrt(1 + ratios**2) - 1)
        return float(loss.sum() + ((self._prior_weights * x) ** 2).sum())

    def variances(self, values: Floats, fixed: NDArray[np.bool_], expected_data: str) -> Floats:
        """Return the variances of the parameters, for residuals of variance 1."""
        x = (values - self._start) / self._scales
        hessian, _ = self._normal_equations(x, self._residuals_at(x), np.ones(1))
        free = np.flatnonzero(~fixed)
        eigenvalues, eigenvectors = np.linalg.eigh(hessian[np.ix_(free, free)])
        if not eigenvalues[0] > _MIN_EIGENVALUE * eigenvalues[-1]:
            worst = self._parameters[int(free[np.abs(eigenvectors[:, 0]).argmax()])]
            raise FitError(f"{worst.name}: cannot be determined; expected {expected_data}")
        covariance = (eigenvectors / eigenvalues) @ eigenvectors.T
        # A deviation of a fixed parameter shifts the estimates of the others.
        shifts = covariance @ hessian[np.ix_(free, np.flatnonzero(fixed))] / self._prior_weights[fixed]
        variances = np.zeros(len(values))
        variances[free] = np.diag(covariance) + (shifts**2).sum(axis=1)
        variances[fixed] = 1 / self._prior_weights[fixed] ** 2
        return variances * self._scales**2

    def _normal_equations(self, x: Floats, residuals: Floats, weights: Floats) -> tuple[Floats, Floats]:
        """Return the matrix (n, n) and the right side (n,) of the normal equations, including priors."""
        n, penalty = len(x), np.diag(self._prior_weights**2)
        if self._sparsity is None:
            jacobian = np.column_stack([self._derivative(x, step) for step in np.eye(n) * self._step])
            weighted = jacobian * weights[:, None]
            return weighted.T @ jacobian + penalty, -(weighted.T @ residuals + self._prior_weights**2 * x)
        steps = [np.where(np.isin(np.arange(n), columns), self._step, 0.0) for columns in self._sparsity.T]
        slopes = [self._derivative(x, step) for step in steps]
        hessian, descent = penalty.ravel(), -(self._prior_weights**2) * x
        for rows, slope in zip(self._sparsity.T, slopes, strict=True):
            descent -= np.bincount(rows, slope * weights * residuals, n)
            for columns, other_slope in zip(self._sparsity.T, slopes, strict=True):
                hessian = hessian + np.bincount(rows * n + columns, slope * weights * other_slope, n * n)
        return hessian.reshape(n, n), descent

    def _residuals_at(self, x: Floats) -> Floats:
        return self._residuals(self._start + x * self._scales)

    def _derivative(self, x: Floats, step: Floats) -> Floats:
        return (self._residuals_at(x + step) - self._residuals_at(x - step)) / (2 * self._step)


def expected_readings(levels: Floats, noise: float | Floats, limit: float) -> Floats:
    """Return the mean reading at levels without noise; noisy readings are clipped to 0 and `limit`."""
    noise = np.maximum(noise, 1e-6)
    low, high = -levels / noise, (limit - levels) / noise
    return noise * (_pdf(low) - _pdf(high)) + levels * (ndtr(high) - ndtr(low)) + limit * ndtr(-high)


def reading_deviations(levels: Floats, noise: float | Floats, limit: float) -> Floats:
    """Return the standard deviation of a clipped, noisy reading; it is small near the ends."""
    noise = np.maximum(noise, 1e-6)
    low, high = -levels / noise, (limit - levels) / noise
    inside = ndtr(high) - ndtr(low)
    squares = (
        (levels**2 + noise**2) * inside
        + 2 * levels * noise * (_pdf(low) - _pdf(high))
        + noise**2 * (low * _pdf(low) - high * _pdf(high))
        + limit**2 * ndtr(-high)
    )
    return np.sqrt(np.maximum(squares - expected_readings(levels, noise, limit) ** 2, 0))


def _pdf(z: Floats) -> Floats:
    return np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
