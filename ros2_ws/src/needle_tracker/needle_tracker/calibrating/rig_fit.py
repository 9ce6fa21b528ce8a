"""Robust least squares on the rig model, with the covariance of the parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.rig_model import RigModel
from needle_tracker.optics.calibration import SIDES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEAST_CORNER_SIGMA_PX = 0.02
LARGEST_MISFIT_PX = 0.1  # about 0.05 mm of depth
_OUTLIER = 3.0  # standard deviations above which the cost of a residual is linear
_LEAST_EIGENVALUE = 1e-14
_ITERATIONS = 40
_LEAST_CHANGE = 1e-4  # of the cost: parameters then change by less than 1 % of their sigma
_LARGEST_DAMPING = 1e6


@dataclasses.dataclass(frozen=True)
class RigFit:
    """A fitted rig.

    Attributes
    ----------
    parameters : ndarray, shape (p,)
        All parameters, including fixed ones.
    covariance : ndarray, shape (p, p)
        Covariance of the parameters; 0 for fixed ones.
    residuals : ndarray, shape (n, 2)
        Measured minus fitted pixels [px].
    corner_sigma_px : float
        Standard deviation of the coordinate of a corner, from the residuals [px].
    cost : float
        Half the sum of squares of residuals and priors over their standard deviations.
    """

    parameters: Array
    covariance: Array
    residuals: Array
    corner_sigma_px: float
    cost: float

    @property
    def sigma(self) -> Array:
        """Standard deviations of the parameters, 0 for fixed ones, shape (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def rms_px(residuals: Array) -> float:
    """Return the root mean square length of residuals, shape (n, 2) [px]; NaN without any."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=-1)))) if len(residuals) else np.nan


def fit(
    model: RigModel, start: Array, names: Collection[str], corner_sigma_px: float | None = None
) -> RigFit:
    """Fit some of the shared parameters, and all boards but those at exact places, to the views.

    Known places and windows are priors with their standard deviations.

    Parameters
    ----------
    model : RigModel
        Model with the views.
    start : ndarray, shape (p,)
        Initial parameters.
    names : collection of str
        Shared parameters to fit.
    corner_sigma_px : float, optional
        Standard deviation of the coordinate of a corner [px]; by default from the residuals.

    Returns
    -------
    RigFit
        The fit.
    """
    free = model.given_sigma > 0.0
    free[: model.shared] = [name in names for name in model.names]
    parameters, normal, cost = _minimize(model, start, free, corner_sigma_px or 0.3)
    residuals = model.residuals(parameters)
    sigma = corner_sigma_px
    if sigma is None:
        weighed = max(_spread(model, residuals, free), LEAST_CORNER_SIGMA_PX)
        parameters, normal, cost = _minimize(model, parameters, free, weighed)
        residuals = model.residuals(parameters)
        sigma = _spread(model, residuals, free)
    covariance = np.zeros((len(start), len(start)))
    covariance[np.ix_(free, free)] = _inverse_normal(normal)
    return RigFit(parameters, covariance, residuals, sigma, cost)


def misfit_px(model: RigModel, result: RigFit) -> float:
    """Return the error of the model: rms of a corner coordinate beyond its noise [px].

    The noise is the residual of a polynomial of degree 4 in the coordinates of the board, which
    fits perspective, lens and refraction to a few thousandths of a pixel.

    Parameters
    ----------
    model : RigModel
        Fitted model.
    result : RigFit
        Result of the fit.
    """
    total, spare = 0.0, 0
    for corners in (view.corners(side) for view in model.views for side in SIDES):
        if not len(corners.points):
            continue
        degree = 4 if len(corners.points) >= 40 else 2
        flat = corners.points[:, :2] - corners.points[:, :2].mean(axis=0)
        x, y = (flat / np.abs(flat).max()).T
        terms = [x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)]
        basis = np.stack(terms, axis=-1)
        rest = corners.pixels - basis @ np.linalg.lstsq(basis, corners.pixels, rcond=None)[0]
        total += float(np.sum(rest**2))
        spare += 2 * max(len(corners.points) - basis.shape[1], 0)
    noise = total / spare if spare else 0.0
    return float(np.sqrt(max(np.mean(result.residuals**2) - noise, 0.0)))


def _minimize(
    model: RigModel, start: Array, free: Mask, sigma: float
) -> tuple[Array, Array, float]:
    """Return parameters, normal matrix at them, and cost.

    Levenberg-Marquardt on the normal equations, with a low weight for outliers (soft L1). scipy's
    `least_squares` takes a minute instead of seconds, since it decomposes the whole Jacobian
    (8,000 x 150) in every step.
    """
    # Inverse variances of the given values; 0 where nothing is given.
    given = model.given_sigma[free] ** -2.0

    def cost_of(parameters: Array) -> tuple[float, Array]:
        pixels = np.nan_to_num(model.residuals(parameters).ravel() / sigma, nan=1e4)
        robust = 2.0 * _OUTLIER**2 * (np.sqrt(1.0 + (pixels / _OUTLIER) ** 2) - 1.0)
        return float(0.5 * (robust.sum() + given @ parameters[free] ** 2)), pixels

    parameters, damping = start.copy(), 1e-6
    cost, pixels = cost_of(parameters)
    normal = np.zeros((0, 0))
    for _ in range(_ITERATIONS):
        weights = 1.0 / np.sqrt(1.0 + (pixels / _OUTLIER) ** 2)
        slopes = np.nan_to_num(model.jacobian(parameters, free) / sigma)
        weighted = slopes * weights[:, None]
        normal = weighted.T @ slopes + np.diag(given)
        gradient = weighted.T @ pixels + given * parameters[free]
        better = False
        while not better and damping < _LARGEST_DAMPING:
            trial = parameters.copy()
            trial[free] -= _solve(normal, gradient, damping)
            trial_cost, trial_pixels = cost_of(trial)
            better = trial_cost <= cost
            damping = damping * 0.1 if better else damping * 10.0
        if not better:
            break
        change = cost - trial_cost
        parameters, cost, pixels = trial, trial_cost, trial_pixels
        if change <= _LEAST_CHANGE:
            break
    return parameters, normal, cost


def _solve(normal: Array, gradient: Array, damping: float) -> Array:
    """Return the damped step, columns scaled to length 1."""
    if not len(gradient):
        return gradient
    scale = _scale(normal)
    scaled = normal / np.outer(scale, scale) + damping * np.eye(len(scale))
    return np.asarray(np.linalg.lstsq(scaled, gradient / scale, rcond=1e-15)[0] / scale)


def _spread(model: RigModel, residuals: Array, free: Mask) -> float:
    """Return the standard deviation of the residuals of a fit, without outliers."""
    if not residuals.size:
        return 0.0
    rough = 1.4826 * float(np.median(np.abs(residuals)))
    unknown = int(np.count_nonzero(np.isinf(model.given_sigma[free])))
    squares = residuals[np.abs(residuals) <= 4.0 * rough] ** 2
    return float(np.sqrt(np.mean(squares) * residuals.size / max(residuals.size - unknown, 1)))


def _inverse_normal(normal: Array) -> Array:
    """Return the inverse, with large but finite variances for undetermined parameters."""
    scale = _scale(normal)
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    values = np.maximum(values, _LEAST_EIGENVALUE)
    inverse = (vectors / values) @ vectors.T
    return np.asarray(inverse / np.outer(scale, scale))


def _scale(normal: Array) -> Array:
    return np.maximum(np.sqrt(np.diag(normal)), 1e-12)
