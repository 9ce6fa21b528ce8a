"""Curvature of the needle's path from tips of pure insertion, with its uncertainty.

Without rotation, the needle follows a circle of radius 1 / kappa ([KC09] IV-B). The tip after the
inserted length l is

    p(l) = p0 + d sin(kappa l) / kappa + n (1 - cos(kappa l)) / kappa

with the entry p0, the heading d there and the direction n in which the needle bends. The most
likely arc is found by Gauss-Newton on p0, two angles of d and the two components of kappa n across
d: in these the problem is almost linear, has no singularity at kappa = 0, and needs no initial
guess of the roll. Heading and entry have priors. Tips far from the arc lose weight, so a few
outliers do no harm. The needle's insertion per recorded insertion of the stage is one more unknown.

Leading axes broadcast.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.curvature.insertion_arc import (
    BEND,
    ENTRY,
    HEADING,
    UNKNOWNS,
    arc_points,
    frame,
    headings,
)
from needle_controller.model.arrays import Array
from needle_core.errors import UserError

FEWEST_TIPS = 8
SHORTEST_ARC = 0.01
"""Fewest tips and shortest insertion [m] for a fit."""
_ITERATIONS = 30
_ROBUST_ITERATIONS = 5
_SMALLEST_NOISE = 1e-9
_ARBITRARY_START = 1e-3
_OUTLIER_LIMIT = 4.0
"""Distance from the arc, in standard deviations of a coordinate, beyond which a tip loses weight
with the 4th power of its distance."""
# Median of a tip's squared distance in variances of a coordinate: about halfway between those for
# normal and for uniform noise.
_MEDIAN_SQUARED = {3: 2.6, 2: 1.5}
# Scales of the unknowns.
_SIZES: Array = np.array([1.0, 1.0, 1.0, 20.0, 20.0, 1e3, 1e3, 20.0])
_GAIN = UNKNOWNS
"""Index of the last unknown, the needle's insertion per insertion of the stage, less 1."""
_HEADING_STD = math.radians(5.0)


@dataclasses.dataclass(frozen=True)
class CurvatureFitSettings:
    """Priors of a fit.

    Attributes
    ----------
    heading : tuple of float
        Direction in which the needle enters.
    heading_std : float
        Its standard deviation about each axis across it [rad]; infinite if it is unknown.
    entry : tuple of float
        The entry point [m].
    entry_std : float
        Its standard deviation along each axis [m]; infinite if it is unknown.
    slip_std : float
        Standard deviation of the relative difference between the insertions of needle and stage.
    repeating_error : float
        Error common to all tips that bows the arc, such as that of a calibration; residuals cannot
        reveal it [m]. A bow of e over a length l adds 8 e / l^2 to the curvature.
    """

    heading: tuple[float, float, float] = (0.0, 0.0, 1.0)
    heading_std: float = _HEADING_STD
    entry: tuple[float, float, float] = (0.0, 0.0, 0.0)
    entry_std: float = 0.0005
    slip_std: float = 0.1
    repeating_error: float = 0.0

    def precision(self) -> Array:
        """Return the priors of `CurvatureFit.unknowns` as inverse variances, (8,)."""
        precision = np.zeros(UNKNOWNS + 1)
        precision[ENTRY] = self.entry_std**-2.0
        precision[HEADING] = self.heading_std**-2.0
        precision[_GAIN] = self.slip_std**-2.0
        return precision


@dataclasses.dataclass(frozen=True)
class CurvatureFit:
    """Fitted curvature.

    Attributes
    ----------
    curvature : ndarray, shape (...)
        kappa [1/m].
    std : ndarray, shape (...)
        Its standard deviation [1/m].
    measurement_std : ndarray, shape (...)
        Standard deviation of one measured coordinate, from the residuals [m].
    weights : ndarray, shape (..., K)
        Weight of each tip, 1 for most tips and near 0 for an outlier.
    residuals : ndarray, shape (..., K, 3)
        Residual of each tip across the arc [m].
    entry : ndarray, shape (..., 3)
        Start of the arc [m].
    entry_std : ndarray, shape (...)
        Its standard deviation along the worst axis [m].
    heading : ndarray, shape (..., 3)
        Direction at the start of the arc.
    heading_std : ndarray, shape (...)
        Its standard deviation about the worst axis [rad].
    slip, slip_std : ndarray, shape (...)
        Relative excess of the stage's insertion over the needle's, and its standard deviation; 0
        and `CurvatureFitSettings.slip_std` if the insertion is not known.
    unknowns : ndarray, shape (..., 8)
        Unknowns of `insertion_arc`, relative to the known entry in the `frame` of the known
        heading, and the needle's insertion per insertion of the stage, less 1.
    length : ndarray, shape (..., K)
        Insertion of the stage at each tip [m]; of the needle if that of the stage is not known.
    insertion_known : bool
        Whether the insertion of the stage is known.
    settings : CurvatureFitSettings
        Priors used.
    warnings : tuple of str
        A line for each unused prior; see `curvature_checks.fit_checked`.
    """

    curvature: Array
    std: Array
    measurement_std: Array
    weights: Array
    residuals: Array
    entry: Array
    entry_std: Array
    heading: Array
    heading_std: Array
    slip: Array
    slip_std: Array
    unknowns: Array
    length: Array
    insertion_known: bool
    settings: CurvatureFitSettings
    warnings: tuple[str, ...] = ()

    @property
    def radius(self) -> Array:
        """1 / kappa [m]; infinite for a straight line."""
        with np.errstate(divide="ignore"):
            return np.asarray(1.0 / self.curvature)

    def radius_interval(self) -> tuple[Array, Array]:
        """Return the 95 % interval of 1 / kappa [m]."""
        least = np.maximum(self.curvature - 1.96 * self.std, 0.0)
        with np.errstate(divide="ignore"):
            return 1.0 / (self.curvature + 1.96 * self.std), 1.0 / least


def fit_curvature(
    tips: npt.ArrayLike,
    insertion: npt.ArrayLike | None,
    settings: CurvatureFitSettings | None = None,
) -> CurvatureFit:
    """Return the most likely curvature of an arc through tips of pure insertion.

    Parameters
    ----------
    tips : array_like, shape (..., K, 3)
        Measured tips [m].
    insertion : array_like, shape (K,) or (..., K), or None
        Insertion of the stage at each tip [m]. If it is None, each tip belongs to the nearest point
        of the arc, and only its distance across the arc counts.
    settings : CurvatureFitSettings, optional
        Priors.

    Returns
    -------
    CurvatureFit
        Curvature and its uncertainty.

    Raises
    ------
    UserError
        Too few tips, too short an arc, or a number that is not finite.
    """
    settings = CurvatureFitSettings() if settings is None else settings
    tips = checked_tips(tips)
    axes = frame(np.asarray(settings.heading, dtype=float))
    precision = settings.precision()
    # In the frame of the known heading, relative to the known entry.
    measured = (tips - np.asarray(settings.entry, dtype=float)) @ axes
    known = insertion is not None
    if insertion is None:
        # The position along the arc is arbitrary then: keep it near the entry.
        precision[2] = max(precision[2], _ARBITRARY_START**-2.0)
        length = measured[..., 2] - np.zeros(())
    else:
        length = np.broadcast_to(np.asarray(insertion, dtype=float), tips.shape[:-1])
    _check_length(length)
    unknowns = np.zeros((*tips.shape[:-2], UNKNOWNS + 1))
    weights = np.ones(tips.shape[:-1])
    for iteration in range(_ITERATIONS):
        inserted = length * (1.0 + unknowns[..., _GAIN:])
        expected, slopes, tangent = arc_points(unknowns[..., :_GAIN], inserted)
        slopes = np.concatenate([slopes, (tangent * length[..., None])[..., None]], axis=-1)
        residual = measured - expected
        along = np.sum(residual * tangent, axis=-1, keepdims=True)
        if not known:
            residual = residual - along * tangent
            across = np.sum(slopes * tangent[..., None], axis=-2, keepdims=True)
            slopes = slopes - tangent[..., None] * across
            length = length + along[..., 0]
        robust = iteration < _ROBUST_ITERATIONS
        sigma = _noise(residual, weights, directions=3 if known else 2, robust=robust)
        squared = np.sum(residual**2, axis=-1) / sigma[..., None] ** 2
        weights = np.minimum(1.0, (_OUTLIER_LIMIT**2 / np.maximum(squared, 1e-9)) ** 2)
        scaled = weights[..., None, None] * slopes
        normal = np.einsum("...kij,...kil->...jl", scaled, slopes)
        gradient = np.einsum("...kij,...ki->...j", scaled, residual)
        weighted = precision * sigma[..., None] ** 2
        normal = normal + np.eye(UNKNOWNS + 1) * weighted[..., None, :]
        inverse = np.linalg.inv(normal * _SIZES[:, None] * _SIZES) * _SIZES[:, None] * _SIZES
        change = np.einsum("...ij,...j->...i", inverse, gradient - weighted * unknowns)
        unknowns = unknowns + change
        if iteration > _ROBUST_ITERATIONS and np.all(np.abs(change[..., BEND]) < 1e-9):
            break
    covariance = inverse * (sigma**2)[..., None, None]
    curvature, std = _length(unknowns[..., BEND], covariance[..., BEND, BEND])
    span = np.max(length, axis=-1) - np.min(length, axis=-1)
    std = np.hypot(std, 8.0 * settings.repeating_error / span**2)
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    return CurvatureFit(
        curvature=curvature,
        std=std,
        measurement_std=sigma,
        weights=weights,
        residuals=(residual - along * tangent) @ axes.T,
        entry=unknowns[..., ENTRY] @ axes.T + np.asarray(settings.entry, dtype=float),
        entry_std=np.sqrt(np.max(variances[..., ENTRY], axis=-1)),
        heading=headings(unknowns[..., HEADING])[..., :, 2] @ axes.T,
        heading_std=np.sqrt(np.max(variances[..., HEADING], axis=-1)),
        slip=1.0 / (1.0 + unknowns[..., _GAIN]) - 1.0,
        slip_std=np.sqrt(variances[..., _GAIN]) / (1.0 + unknowns[..., _GAIN]) ** 2,
        unknowns=unknowns,
        length=length,
        insertion_known=known,
        settings=settings,
    )


def checked_tips(tips: npt.ArrayLike) -> Array:
    """Check tips and return them as an array, shape (..., K, 3); raises UserError if unusable."""
    tips = np.asarray(tips, dtype=float)
    count = tips.shape[-2] if tips.ndim >= 2 else 0
    if count < FEWEST_TIPS:
        raise UserError(f"{count} tips are too few for a curvature, minimum {FEWEST_TIPS}")
    if not np.all(np.isfinite(tips)):
        raise UserError("a tip is not finite")
    return tips


def _check_length(length: Array) -> None:
    if not np.all(np.isfinite(length)):
        raise UserError("an insertion is not finite")
    span = float(np.min(np.max(length, axis=-1) - np.min(length, axis=-1)))
    if span < SHORTEST_ARC:
        raise UserError(
            f"{span:.4g} m of insertion are too short for a curvature, minimum {SHORTEST_ARC:g} m"
        )


def _noise(residual: Array, weights: Array, *, directions: int, robust: bool) -> Array:
    """Return the standard deviation of one coordinate, from the tips that are not outliers."""
    squared = np.sum(residual**2, axis=-1)
    if robust:
        variance = np.median(squared, axis=-1) / _MEDIAN_SQUARED[directions]
    else:
        good = weights >= 1.0
        degrees = np.maximum(directions * np.sum(good, axis=-1) - UNKNOWNS, 1.0)
        variance = np.sum(np.where(good, squared, 0.0), axis=-1) / degrees
    return np.asarray(np.sqrt(np.maximum(variance, _SMALLEST_NOISE**2)))


def _length(bend: Array, covariance: Array) -> tuple[Array, Array]:
    """Return the length of a noisy vector of two components, and its standard deviation."""
    length = np.sqrt(np.sum(bend**2, axis=-1))
    unit = bend / np.maximum(length, 1e-12)[..., None]
    # The bend of a straight line has no direction: average over all directions.
    mean = 0.5 * np.trace(covariance, axis1=-2, axis2=-1)
    along = np.einsum("...i,...ij,...j->...", unit, covariance, unit)
    return length, np.sqrt(np.where(length > 1e-9, along, mean))


def circle_curvature(tips: npt.ArrayLike) -> Array:
    """Return the curvature of the plain least-squares circle ([KC09] IV-B), for comparison.

    The plane is that of the two largest principal axes; the circle minimizes the sum of (|p - c|^2
    - r^2)^2. The result is biased, because noise along a short arc looks like curvature: with +-1
    mm of noise on 60 mm, it is a quarter too large. Use `fit_curvature`.

    Parameters
    ----------
    tips : array_like, shape (..., K, 3)
        Measured tips [m].

    Returns
    -------
    ndarray, shape (...)
        1 / r [1/m].
    """
    tips = np.asarray(tips, dtype=float)
    centred = tips - np.mean(tips, axis=-2, keepdims=True)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ np.swapaxes(axes[..., :2, :], -1, -2)
    squared = np.sum(flat**2, axis=-1)
    design = np.concatenate([2.0 * flat, np.ones_like(flat[..., :1])], axis=-1)
    transposed = np.swapaxes(design, -1, -2)
    solution = np.linalg.solve(transposed @ design, transposed @ squared[..., None])[..., 0]
    radius = np.sqrt(solution[..., 2] + np.sum(solution[..., :2] ** 2, axis=-1))
    return np.asarray(1.0 / radius)
