"""Two image tips to one tip in space: tight across the needle, loose along it.

Across the shaft an image says a lot (the line is fitted to some forty rows of pixels), along it
little (where a bevelled end fades). Each camera's measurement is weighted accordingly, so that the
badly seen end hardly touches the depth.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_tracker.image.tip_fit import ImageTip
from needle_tracker.optics.compiled_projection import pixel_ray, solve_position
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.optics.vectors import cross, dot

Array = NDArray[np.float64]

_ITERATIONS = 12
_LEAST_SINE = 1e-3  # of the angle between the planes in which the two views see the shaft
_ALONG_SIGMAS, _ALONG_DOUBT = 3.0, 0.6


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
    disagreement : float
        By how much the cameras disagree about the end along the shaft [m].
    disagreement_across : float
        By how much more than expected the end misses the two shaft lines [px].
    """

    position: Array
    covariance: Array
    direction: Array
    direction_covariance: Array
    disagreement: float
    disagreement_across: float


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
    views: tuple[RefractedCamera, RefractedCamera], tips: tuple[ImageTip, ImageTip]
) -> SpatialTip | None:
    """Return the tip that fits both images best.

    Gauss-Newton on the four image residuals (across and along the shaft, per camera), each over its
    standard deviation; the covariance is the inverse of the normal matrix.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    tips : pair of ImageTip
        The needle's end in the left and right image.

    Returns
    -------
    SpatialTip or None
        None where the two views do not determine a point.
    """
    position = midpoint(views, (tips[0].point, tips[1].point))
    if not np.all(np.isfinite(position)):
        return None
    axes = np.array(
        [[[-tip.direction[1], tip.direction[0]], tip.direction] for tip in tips]
    )  # rows: across, along
    sigmas = np.array([s for tip in tips for s in (tip.sigma_across, tip.sigma_along)])
    position = np.array(position)
    converged, normal, residual, jacobians = solve_position(
        (views[0].packed, views[1].packed),
        np.stack([tip.point for tip in tips]),
        axes,
        sigmas,
        position,
        _ITERATIONS,
    )
    if not converged:
        return None
    direction, direction_covariance = np.empty(3), np.empty((3, 3))
    sigma_angles = np.array([tip.sigma_angle for tip in tips])
    if not _shaft_direction(jacobians, axes, sigma_angles, direction, direction_covariance):
        return None
    if direction_covariance.trace() > 1.0:
        return None
    # Residual along the shaft in the images, as lengths along the shaft in space.
    scales = [float(axis[1] @ j @ direction) for axis, j in zip(axes, jacobians, strict=True)]
    # An end that only one camera sees has nothing to disagree with.
    along = 0.0
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    if tips[0].clear and tips[1].clear:
        along = abs(residual[1] / scales[0] - residual[3] / scales[1])
        # Two ends that are too far apart: one of them is wrong, and nothing says which.
        sigma = math.hypot(tips[0].sigma_along / scales[0], tips[1].sigma_along / scales[1])
        doubt = max(along * along - (_ALONG_SIGMAS * sigma) ** 2, 0.0)
        covariance += _ALONG_DOUBT**2 * doubt * np.outer(direction, direction)
    else:
        # A line is good for nothing far from where it was seen.
        along = max(
            max(abs(float(residual[k])) - float(sigmas[k]), 0.0) / abs(scale)
            for k, scale in zip((1, 3), scales, strict=True)
        )
    return SpatialTip(
        position,
        covariance,
        direction,
        direction_covariance,
        float(along),
        max(_beyond(residual[0], sigmas[0]), _beyond(residual[2], sigmas[2])),
    )


def _beyond(residual: float, sigma: float) -> float:
    """Return how far a residual goes beyond what its standard deviation explains [px]."""
    return max(abs(float(residual)) - 3.0 * float(sigma), 0.0)


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
