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

from needle_tracker.compiled_projection import solve_position
from needle_tracker.refraction import RefractedCamera
from needle_tracker.tip_fit import ImageTip

Array = NDArray[np.float64]

_ITERATIONS = 12
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
    rays = [view.rays(tip) for view, tip in zip(views, tips, strict=True)]
    (p, a), (q, b) = rays
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
        None where the two views do not determine a point (or one above the surface).
    """
    position = midpoint(views, (tips[0].point, tips[1].point))
    if not np.all(np.isfinite(position)):
        return None
    axes = [
        np.stack([[-tip.direction[1], tip.direction[0]], tip.direction]) for tip in tips
    ]  # rows: across, along
    sigmas = np.array([s for tip in tips for s in (tip.sigma_across, tip.sigma_along)])
    position = np.array(position)
    converged, normal, residual, found = solve_position(
        np.stack([view.packed for view in views]),
        np.stack([tip.point for tip in tips]),
        np.stack(axes),
        sigmas,
        position,
        _ITERATIONS,
    )
    if not converged:
        return None
    jacobians = [found[0], found[1]]
    heading = _shaft_direction(jacobians, axes, [tip.sigma_angle for tip in tips])
    if heading is None:
        return None
    direction, direction_covariance = heading
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


def _shaft_direction(
    jacobians: list[Array], axes: list[Array], sigma_angles: list[float]
) -> tuple[Array, Array] | None:
    """Return the shaft's direction in `rig`, and its covariance.

    Seen through a camera's Jacobian J, the direction d runs along the image line: n . J d = 0 with
    n across the line. So d is across both J^T n: the intersection of two planes.
    """
    normals = [j.T @ axis[0] for j, axis in zip(jacobians, axes, strict=True)]
    cross = np.cross(normals[0], normals[1])
    length = float(np.linalg.norm(cross))
    sine = length / float(np.linalg.norm(normals[0]) * np.linalg.norm(normals[1]))
    if not sine > 1e-3:
        return None
    direction = cross / length
    if float(axes[0][1] @ jacobians[0] @ direction) < 0.0:
        direction = -direction
    if float(axes[1][1] @ jacobians[1] @ direction) <= 0.0:
        return None
    # Turning an image line by da moves its n by -da t (t along): dn = -da J^T t.
    covariance = np.zeros((3, 3))
    for i in range(2):
        change = -jacobians[i].T @ axes[i][1]
        turned = np.cross(change, normals[1]) if i == 0 else np.cross(normals[0], change)
        across = (turned - direction * float(direction @ turned)) / length
        covariance += sigma_angles[i] ** 2 * np.outer(across, across)
    return direction, covariance
