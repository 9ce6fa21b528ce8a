"""Triangulate the ends of both views: tight across the needle, loose along it.

Each view tells the end to a few hundredths of a pixel across the shaft, from its line, and to a
pixel or so along it. Least squares weights both accordingly, so that an end that is poorly seen
hardly touches the depth.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.detector.end_fit import ImageEnd
from needle_tracker.optics.compiled_projection import pixel_ray, solve_position
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.vectors import cross, dot

Array = NDArray[np.float64]

_ITERATIONS = 12
_LEAST_SINE = 1e-3  # of the angle between the planes in which the two views see the shaft


@dataclasses.dataclass(frozen=True)
class SpatialTip:
    """The tip in `rig`.

    Attributes
    ----------
    position : ndarray, shape (3,)
        The visible end [m].
    covariance : ndarray, shape (3, 3)
        Of the position [m^2].
    direction : ndarray, shape (3,)
        Unit vector along the visible shaft near the tip, towards the tip.
    direction_covariance : ndarray, shape (3, 3)
        Of the direction [-]; zero along it.
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
        NaN for parallel rays.
    """
    p, a, q, b = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    pixel_ray(views[0].packed, np.asarray(tips[0], dtype=np.float64), p, a)
    pixel_ray(views[1].packed, np.asarray(tips[1], dtype=np.float64), q, b)
    cosine = float(a @ b)
    denominator = 1.0 - cosine * cosine
    if not denominator > 1e-9:
        return np.full(3, np.nan)
    between = q - p
    along_a = float(between @ a - cosine * (between @ b)) / denominator
    along_b = float(cosine * (between @ a) - between @ b) / denominator
    return np.asarray(0.5 * (p + along_a * a + q + along_b * b))


def triangulate(
    views: tuple[RefractedCamera, RefractedCamera], ends: tuple[ImageEnd, ImageEnd]
) -> SpatialTip | None:
    """Return the tip that fits both images best.

    Gauss-Newton on the four image residuals (across and along the shaft, per camera), each over its
    standard deviation; the covariance is the inverse of the normal matrix.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    ends : pair of ImageEnd
        The needle's end in the left and right image.

    Returns
    -------
    SpatialTip or None
        None where the two views do not determine a point.
    """
    position = midpoint(views, (ends[0].point, ends[1].point))
    if not np.all(np.isfinite(position)):
        return None
    axes = np.array(
        [[[-end.direction[1], end.direction[0]], end.direction] for end in ends]
    )  # rows: across, along
    sigmas = np.array([s for end in ends for s in (end.sigma_across, end.sigma_along)])
    position = np.array(position)
    converged, normal, residual, jacobians = solve_position(
        (views[0].packed, views[1].packed),
        np.stack([end.point for end in ends]),
        axes,
        sigmas,
        position,
        _ITERATIONS,
    )
    if not converged:
        return None
    direction, direction_covariance = np.empty(3), np.empty((3, 3))
    sigma_angles = np.array([end.sigma_angle for end in ends])
    if not _shaft_direction(jacobians, axes, sigma_angles, direction, direction_covariance):
        return None
    if direction_covariance.trace() > 1.0:
        return None
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    misfit = float(np.sum((residual / sigmas) ** 2))
    return SpatialTip(position, covariance, direction, direction_covariance, misfit)


@compiled
def _shaft_direction(
    jacobians: Array, axes: Array, sigma_angles: Array, direction: Array, covariance: Array
) -> bool:
    """Write the shaft's direction in `rig`, and its covariance; return whether the views tell it.

    Seen through a camera's Jacobian J, the direction d runs along the image line: n . J d = 0 with
    n across the line. So d is across both J^T n: the intersection of two planes.
    """
    normals, alongs = np.empty((2, 3)), np.empty((2, 3))
    for i in range(2):
        for k in range(3):
            normals[i, k] = axes[i, 0, 0] * jacobians[i, 0, k] + axes[i, 0, 1] * jacobians[i, 1, k]
            alongs[i, k] = axes[i, 1, 0] * jacobians[i, 0, k] + axes[i, 1, 1] * jacobians[i, 1, k]
    cross(normals[0], normals[1], direction)
    length = math.sqrt(dot(direction, direction))
    product = math.sqrt(dot(normals[0], normals[0]) * dot(normals[1], normals[1]))
    if not length > _LEAST_SINE * product:
        return False
    # Towards the tip in the left image; then it must be so in the right one.
    sign = -1.0 if dot(alongs[0], direction) < 0.0 else 1.0
    for k in range(3):
        direction[k] *= sign / length
    if dot(alongs[1], direction) <= 0.0:
        return False
    # Turning an image line by da moves its n by -da t (t along): dn = -da J^T t.
    turned = np.empty(3)
    covariance[:] = 0.0
    for i in range(2):
        cross(alongs[i], normals[1 - i], turned)
        away = dot(direction, turned)
        for a in range(3):
            for b in range(3):
                covariance[a, b] += (
                    (sigma_angles[i] / length) ** 2
                    * (turned[a] - away * direction[a])
                    * (turned[b] - away * direction[b])
                )
    return True
