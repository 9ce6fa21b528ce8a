"""Triangulation of the ends in both views: tight across the needle, loose along it.

A view determines the end to a few hundredths of a pixel across the shaft, from its line, and to
about a pixel along it. Least squares weights both accordingly, so that a poorly visible end hardly
affects the depth.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.optics.refraction import RefractedCamera

Array = NDArray[np.float64]

_ITERATIONS = 12
_CONVERGED = 1e-10  # step below which a position has converged [m]
_SINGULAR = 1e-10  # scaled determinant below which a matrix counts as singular [-]
_LEAST_SINE = 1e-3  # least sine of the angle between the planes through a camera and the shaft
_LARGEST_VARIANCE = 1.0  # largest total variance of a determined direction [-]
_IMAGE_AXES, _EQUAL = np.stack([np.eye(2)] * 2), np.ones((2, 2))


@dataclasses.dataclass(frozen=True)
class SpatialTip:
    """Measured tip, in `rig`.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Visible end [m].
    covariance : ndarray, shape (3, 3)
        Covariance of the position [m^2]: of the fit alone, or of a published tip with the errors
        that persist from pair to pair (`NeedleTracker`).
    direction : ndarray, shape (3,)
        Unit vector along the visible shaft near the tip, towards the tip.
    direction_covariance : ndarray, shape (3, 3)
        Covariance of the direction [-]; zero along it.
    misfit : float
        Squared residuals of both views over their variances: chi-squared, one degree of freedom.
    """

    position: Array
    covariance: Array
    direction: Array
    direction_covariance: Array
    misfit: float = 0.0


def squared_distance(off: Array, covariance: Array) -> float:
    """Return the squared Mahalanobis distance of a deviation, (3,), with its covariance, (3, 3)."""
    return float(off @ np.linalg.solve(covariance, off))


def triangulate(
    views: tuple[RefractedCamera, RefractedCamera], ends: tuple[ImageEnd, ImageEnd], start: Array
) -> SpatialTip | None:
    """Return the least-squares tip of both images.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    ends : pair of ImageEnd
        End of the needle in the left and the right image.
    start : ndarray, shape (3,)
        Approximate position in `rig` [m].

    Returns
    -------
    SpatialTip or None
        None if the two views do not determine position and direction.
    """
    points = np.stack([end.point for end in ends])
    axes = np.array([[[-end.direction[1], end.direction[0]], end.direction] for end in ends])
    sigmas = np.array([[end.sigma_across, end.sigma_along] for end in ends])
    found = locate(views, points, start, axes, sigmas)
    if found is None:
        return None
    position, covariance, residuals = found
    slopes = axes @ np.stack([view.jacobian(position) for view in views])
    sigma_angles = np.array([end.sigma_angle for end in ends])
    shaft = _shaft_direction(slopes[:, 0], slopes[:, 1], sigma_angles)
    if shaft is None:
        return None
    return SpatialTip(position, covariance, *shaft, float(np.sum(residuals**2)))


def locate(
    views: tuple[RefractedCamera, RefractedCamera],
    points: Array,
    start: Array,
    axes: Array = _IMAGE_AXES,
    sigmas: Array = _EQUAL,
) -> tuple[Array, Array, Array] | None:
    """Fit a position to its two image points, by Gauss-Newton.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    points : ndarray, shape (2, 2)
        Left and right image point [px].
    start : ndarray, shape (3,)
        Approximate position in `rig` [m].
    axes : ndarray, shape (2, 2, 2)
        Per view two perpendicular unit vectors; by default along u and v.
    sigmas : ndarray, shape (2, 2)
        Standard deviations of the points along the axes [px].

    Returns
    -------
    position : ndarray, shape (3,)
        Position in `rig` [m].
    covariance : ndarray, shape (3, 3)
        Its covariance [m^2]: the inverse of the normal matrix.
    residuals : ndarray, shape (4,)
        Residuals along the axes over `sigmas`.
    None is returned in place of all three if the views do not determine a position.
    """
    position = start
    for _ in range(_ITERATIONS):
        slopes = np.stack([view.jacobian(position) for view in views])
        off = points - np.stack([view.project(position) for view in views])
        rows = (axes @ slopes / sigmas[..., None]).reshape(4, 3)
        residuals = (np.einsum("vij,vj->vi", axes, off) / sigmas).ravel()
        normal = rows.T @ rows
        # Scaled by its diagonal, the determinant shows how well the position is determined.
        if not np.linalg.det(normal) > _SINGULAR * np.prod(np.diag(normal)):
            return None
        step = np.linalg.solve(normal, rows.T @ residuals)
        position = position + step
        if np.abs(step).max() < _CONVERGED:
            return position, np.linalg.inv(normal), residuals
    return None


def _shaft_direction(
    normals: Array, alongs: Array, sigma_angles: Array
) -> tuple[Array, Array] | None:
    """Return the direction of the shaft in `rig` and its covariance; None if undetermined.

    Seen through the Jacobian J of a camera, the direction d runs along the image line: n . J d = 0
    with n perpendicular to the line. So d is perpendicular to both J^T n: the intersection of two
    planes.

    Parameters
    ----------
    normals, alongs : ndarray, shape (2, 3)
        J^T n and J^T t of both views, with t along the image line.
    sigma_angles : ndarray, shape (2,)
        Standard deviations of the directions of the image lines [rad].
    """
    direction = np.cross(*normals)
    length = float(np.linalg.norm(direction))
    if not length > _LEAST_SINE * float(np.prod(np.linalg.norm(normals, axis=1))):
        return None
    # The direction must be towards the tip in both images.
    direction = direction / np.copysign(length, alongs[0] @ direction)
    if alongs[1] @ direction <= 0.0:
        return None
    # A rotation of an image line by da changes its n by -da t: dn = -da J^T t.
    turned = np.cross(alongs, normals[::-1]) * (sigma_angles / length)[:, None]
    turned -= np.outer(turned @ direction, direction)
    covariance = turned.T @ turned
    return (direction, covariance) if covariance.trace() <= _LARGEST_VARIANCE else None
