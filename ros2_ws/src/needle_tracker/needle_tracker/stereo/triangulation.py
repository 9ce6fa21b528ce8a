"""Triangulation of the ends in both views: tight across the needle, loose along it.

A view determines the end to a few hundredths of a pixel across the shaft, from its line, and to
about a pixel along it. Least squares weights both accordingly, so that a poorly visible end hardly
affects the depth.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.optics.refraction import (
    RefractedCamera,
    cross,
    dot,
    pixel_ray,
    point_jacobian,
    project_point,
)

Array = NDArray[np.float64]

_ITERATIONS = 12
_ROUNDING = 1e-10  # step of a converged position [m]; scaled determinant of a singular matrix
_LEAST_SINE = 1e-3  # least sine of the angle between the planes through a camera and the shaft


@dataclasses.dataclass(frozen=True)
class SpatialTip:
    """Measured tip, in `rig`.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Visible end [m].
    covariance : ndarray, shape (3, 3)
        Covariance of the position [m^2].
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


def midpoint(views: tuple[RefractedCamera, RefractedCamera], tips: tuple[Array, Array]) -> Array:
    """Return the point halfway between two refracted rays at their closest, in `rig` [m].

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    tips : pair of ndarray, shape (2,)
        Pixels, left and right.

    Returns
    -------
    ndarray, shape (3,)
        Midpoint; NaN for parallel rays.
    """
    p, a, q, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    pixel_ray(views[0].packed, np.asarray(tips[0], dtype=np.float64), p, a)
    pixel_ray(views[1].packed, np.asarray(tips[1], dtype=np.float64), q, b)
    cosine = float(a @ b)
    denominator = 1.0 - cosine * cosine
    if not denominator > 0.0:
        return np.full(3, np.nan)
    between = q - p
    along_a = float(between @ a - cosine * (between @ b)) / denominator
    along_b = float(cosine * (between @ a) - between @ b) / denominator
    return np.asarray(0.5 * (p + along_a * a + q + along_b * b))


def triangulate(
    views: tuple[RefractedCamera, RefractedCamera], ends: tuple[ImageEnd, ImageEnd]
) -> SpatialTip | None:
    """Return the least-squares tip of both images.

    Gauss-Newton on the four image residuals (across and along the shaft, per camera), each over its
    standard deviation; the covariance is the inverse of the normal matrix.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    ends : pair of ImageEnd
        End of the needle in the left and the right image.

    Returns
    -------
    SpatialTip or None
        None if the two views do not determine a point.
    """
    position = midpoint(views, (ends[0].point, ends[1].point))
    if not np.all(np.isfinite(position)):
        return None
    axes = np.array(
        [[[-end.direction[1], end.direction[0]], end.direction] for end in ends]
    )  # rows: across, along
    sigmas = np.array([s for end in ends for s in (end.sigma_across, end.sigma_along)])
    converged, normal, residual, jacobians = _solve_position(
        (views[0].packed, views[1].packed),
        np.stack([end.point for end in ends]),
        axes,
        sigmas,
        position,
    )
    if not converged:
        return None
    direction, direction_covariance = np.empty(3), np.zeros((3, 3))
    sigma_angles = np.array([end.sigma_angle for end in ends])
    if not _shaft_direction(jacobians, axes, sigma_angles, direction, direction_covariance):
        return None
    if direction_covariance.trace() > 1.0:
        return None
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    misfit = float(np.sum(residual**2))
    return SpatialTip(position, covariance, direction, direction_covariance, misfit)


@compiled
def _solve_position(
    cameras: tuple[Array, Array], points: Array, axes: Array, sigmas: Array, position: Array
) -> tuple[bool, Array, Array, Array]:
    """Fit a position to two image points, each known across and along its shaft.

    Parameters
    ----------
    cameras : pair of ndarray
        Packed cameras, from `pack_camera`.
    points : ndarray, shape (2, 2)
        Image points [px].
    axes : ndarray, shape (2, 2, 2)
        Per camera the unit vectors across and along the shaft.
    sigmas : ndarray, shape (4,)
        Standard deviations: left across, left along, right across, right along [px].
    position : ndarray, shape (3,)
        Initial value, replaced by the result [m].

    Returns
    -------
    converged : bool
        Whether the iteration converged.
    normal : ndarray, shape (3, 3)
        Normal matrix: the inverse of the covariance.
    residual : ndarray, shape (4,)
        Residuals over `sigmas`.
    jacobians : ndarray, shape (2, 2, 3)
        Jacobians of both cameras at the position [px/m].
    """
    jacobians, rows, residual = np.empty((2, 2, 3)), np.empty((4, 3)), np.empty(4)
    normal, pixel = np.zeros((3, 3)), np.empty(2)
    for _ in range(_ITERATIONS):
        for i in range(2):
            project_point(cameras[i], position, pixel)
            point_jacobian(cameras[i], position, jacobians[i])
            off = points[i] - pixel
            for k in range(2):
                across, along = axes[i, k] / sigmas[2 * i + k]
                residual[2 * i + k] = across * off[0] + along * off[1]
                rows[2 * i + k] = across * jacobians[i, 0] + along * jacobians[i, 1]
        normal = rows.T @ rows
        # Scaled by its diagonal, the determinant shows how well the position is determined.
        product = normal[0, 0] * normal[1, 1] * normal[2, 2]
        # A NaN from a point behind a camera must not reach det().
        if not (0.0 < product < math.inf and np.linalg.det(normal) > _ROUNDING * product):
            break
        step = np.linalg.solve(normal, rows.T @ residual)
        position += step
        if np.abs(step).max() < _ROUNDING:
            return True, normal, residual, jacobians
    return False, normal, residual, jacobians


@compiled
def _shaft_direction(
    jacobians: Array, axes: Array, sigma_angles: Array, direction: Array, covariance: Array
) -> bool:
    """Write the direction of the shaft in `rig`, and add its covariance; False if undetermined.

    Seen through the Jacobian J of a camera, the direction d runs along the image line: n . J d = 0
    with n perpendicular to the line. So d is perpendicular to both J^T n: the intersection of two
    planes.
    """
    normals, alongs, turned = np.empty((2, 3)), np.empty((2, 3)), np.empty(3)
    for i in range(2):
        normals[i] = axes[i, 0, 0] * jacobians[i, 0] + axes[i, 0, 1] * jacobians[i, 1]
        alongs[i] = axes[i, 1, 0] * jacobians[i, 0] + axes[i, 1, 1] * jacobians[i, 1]
    cross(normals[0], normals[1], direction)
    length = math.sqrt(dot(direction, direction))
    product = math.sqrt(dot(normals[0], normals[0]) * dot(normals[1], normals[1]))
    if not length > _LEAST_SINE * product:
        return False
    # The direction must be towards the tip in both images.
    direction /= -length if dot(alongs[0], direction) < 0.0 else length
    if dot(alongs[1], direction) <= 0.0:
        return False
    # A rotation of an image line by da changes its n by -da t (t along): dn = -da J^T t.
    for i in range(2):
        cross(alongs[i], normals[1 - i], turned)
        turned -= dot(direction, turned) * direction
        covariance += (sigma_angles[i] / length) ** 2 * np.outer(turned, turned)
    return True
