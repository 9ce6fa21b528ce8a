"""One point through the refracting surface into one camera, and back: for the tracker's loops.

The same model as `refraction`, which serves arrays and documents it; the tests hold the two
together.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_common.compiled import compiled
from needle_tracker.optics.calibration import Camera, Phantom

Array = NDArray[np.float64]

_ITERATIONS = 40
_UNDISTORT_ITERATIONS = 12
_UNDISTORTED = 1e-9  # what is inverted so well is, at unit focal length
_JACOBIAN_STEP = 1e-5  # [m]


def pack_camera(camera: Camera, phantom: Phantom) -> Array:
    """Return all that projection needs, as the array that `project_point` takes."""
    return np.concatenate(
        [
            camera.T_optical_rig[:3, :3].reshape(-1),
            camera.T_optical_rig[:3, 3],
            camera.centre,
            camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
            camera.distortion,
            [phantom.surface_height, phantom.refractive_index],
        ]
    )


@compiled
def project_point(camera: Array, point: Array, pixel: Array) -> None:
    """Write the pixel at which a camera sees a point.

    Parameters
    ----------
    camera : ndarray
        From `pack_camera`.
    point : ndarray, shape (3,)
        In `rig` [m].
    pixel : ndarray, shape (2,)
        Takes the result; NaN behind the camera.
    """
    surface, index = camera[24], camera[25]
    offset_y, offset_z = point[1] - camera[13], point[2] - camera[14]
    depth = surface - point[0]
    target_x, target_y, target_z = point[0], point[1], point[2]
    if depth > 0.0:
        height = camera[12] - surface
        distance = math.sqrt(offset_y * offset_y + offset_z * offset_z)
        low, high = 0.0, distance
        rho = distance * index * height / (index * height + depth)
        for _ in range(_ITERATIONS):
            rest = distance - rho
            air2, body2 = rho * rho + height * height, rest * rest + depth * depth
            air, body = math.sqrt(air2), math.sqrt(body2)
            value = rho / air - index * rest / body
            slope = height * height / (air2 * air) + index * depth * depth / (body2 * body)
            if value < 0.0:
                low = rho
            else:
                high = rho
            following = rho - value / slope
            if not low <= following <= high:
                following = 0.5 * (low + high)
            change = abs(following - rho)
            rho = following
            if change <= 1e-15 * distance:
                break
        ratio = rho / distance if distance > 0.0 else 1.0
        target_x = surface
        target_y = camera[13] + offset_y * ratio
        target_z = camera[14] + offset_z * ratio
    x = camera[0] * target_x + camera[1] * target_y + camera[2] * target_z + camera[9]
    y = camera[3] * target_x + camera[4] * target_y + camera[5] * target_z + camera[10]
    z = camera[6] * target_x + camera[7] * target_y + camera[8] * target_z + camera[11]
    if z <= 0.0:
        pixel[0] = pixel[1] = np.nan
        return
    x /= z
    y /= z
    k1, k2, p1, p2, k3 = camera[19], camera[20], camera[21], camera[22], camera[23]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    pixel[0] = camera[15] * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + camera[17]
    pixel[1] = camera[16] * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + camera[18]


@compiled
def pixel_ray(camera: Array, pixel: Array, origin: Array, direction: Array) -> None:
    """Write the refracted ray that a pixel looks along.

    Parameters
    ----------
    camera : ndarray
        From `pack_camera`.
    pixel : ndarray, shape (2,)
        Pixel coordinates.
    origin, direction : ndarray, shape (3,)
        Take the point of the surface in `rig` [m] and the unit vector into the phantom; NaN for a
        pixel that does not look down, or where the distortion has no inverse.
    """
    k1, k2, p1, p2, k3 = camera[19], camera[20], camera[21], camera[22], camera[23]
    seen_x = (pixel[0] - camera[17]) / camera[15]
    seen_y = (pixel[1] - camera[18]) / camera[16]
    x, y = seen_x, seen_y
    miss_x = miss_y = 0.0
    for _ in range(_UNDISTORT_ITERATIONS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        miss_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - seen_x
        miss_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - seen_y
        if abs(miss_x) + abs(miss_y) < 1e-15:
            break
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        j_xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
        j_yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
        j_xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
        det = j_xx * j_yy - j_xy * j_xy
        x -= (j_yy * miss_x - j_xy * miss_y) / det
        y -= (j_xx * miss_y - j_xy * miss_x) / det
    length = math.sqrt(x * x + y * y + 1.0)
    x, y, z = x / length, y / length, 1.0 / length
    down = -(camera[0] * x + camera[3] * y + camera[6] * z)
    if not (down > 0.0 and abs(miss_x) + abs(miss_y) < _UNDISTORTED):
        origin[:] = np.nan
        direction[:] = np.nan
        return
    across = camera[1] * x + camera[4] * y + camera[7] * z
    along = camera[2] * x + camera[5] * y + camera[8] * z
    reach = (camera[12] - camera[24]) / down
    origin[0] = camera[24]
    origin[1] = camera[13] + reach * across
    origin[2] = camera[14] + reach * along
    # Snell: the part along the surface shrinks by the index; unit length gives the rest.
    direction[1], direction[2] = across / camera[25], along / camera[25]
    direction[0] = -math.sqrt(1.0 - direction[1] * direction[1] - direction[2] * direction[2])


@compiled
def point_jacobian(camera: Array, point: Array, jacobian: Array) -> None:
    """Write d(pixel)/d(point) [px/m] into `jacobian`, shape (2, 3)."""
    moved = point.copy()
    ahead, behind = np.empty(2), np.empty(2)
    for axis in range(3):
        moved[axis] = point[axis] + _JACOBIAN_STEP
        project_point(camera, moved, ahead)
        moved[axis] = point[axis] - _JACOBIAN_STEP
        project_point(camera, moved, behind)
        moved[axis] = point[axis]
        jacobian[0, axis] = (ahead[0] - behind[0]) / (2.0 * _JACOBIAN_STEP)
        jacobian[1, axis] = (ahead[1] - behind[1]) / (2.0 * _JACOBIAN_STEP)


@compiled
def solve_position(
    cameras: Array, points: Array, axes: Array, sigmas: Array, position: Array, iterations: int
) -> tuple[int, Array, Array, Array]:
    """Fit a position to two image points, each known across and along its shaft.

    Parameters
    ----------
    cameras : ndarray, shape (2, 26)
        From `pack_camera`.
    points : ndarray, shape (2, 2)
        Image points [px].
    axes : ndarray, shape (2, 2, 2)
        Per camera the unit vectors across and along the shaft.
    sigmas : ndarray, shape (4,)
        Standard deviations: left across, left along, right across, right along [px].
    position : ndarray, shape (3,)
        Where to start; takes the result [m].
    iterations : int
        Most steps.

    Returns
    -------
    converged : int
        1 if so.
    normal : ndarray, shape (3, 3)
        Normal matrix: the inverse of the covariance.
    residual : ndarray, shape (4,)
        In the order of `sigmas` [px].
    jacobians : ndarray, shape (2, 2, 3)
        Of both cameras at the position [px/m].
    """
    jacobians = np.empty((2, 2, 3))
    rows = np.empty((4, 3))
    residual = np.empty(4)
    normal = np.zeros((3, 3))
    pixel = np.empty(2)
    for _ in range(iterations):
        for i in range(2):
            project_point(cameras[i], position, pixel)
            point_jacobian(cameras[i], position, jacobians[i])
            for k in range(2):
                residual[2 * i + k] = axes[i, k, 0] * (points[i, 0] - pixel[0]) + axes[i, k, 1] * (
                    points[i, 1] - pixel[1]
                )
                for axis in range(3):
                    rows[2 * i + k, axis] = (
                        axes[i, k, 0] * jacobians[i, 0, axis]
                        + axes[i, k, 1] * jacobians[i, 1, axis]
                    )
        normal[:] = 0.0
        right = np.zeros(3)
        for k in range(4):
            weight = 1.0 / (sigmas[k] * sigmas[k])
            for a in range(3):
                right[a] += weight * rows[k, a] * residual[k]
                for b in range(3):
                    normal[a, b] += weight * rows[k, a] * rows[k, b]
        # Scaled by its diagonal, the determinant says how well the position is determined.
        product = normal[0, 0] * normal[1, 1] * normal[2, 2]
        c00 = normal[1, 1] * normal[2, 2] - normal[1, 2] * normal[2, 1]
        c01 = normal[0, 2] * normal[2, 1] - normal[0, 1] * normal[2, 2]
        c02 = normal[0, 1] * normal[1, 2] - normal[0, 2] * normal[1, 1]
        det = normal[0, 0] * c00 + normal[1, 0] * c01 + normal[2, 0] * c02
        if not (product > 0.0 and det > 1e-10 * product):
            return 0, normal, residual, jacobians
        c11 = normal[0, 0] * normal[2, 2] - normal[0, 2] * normal[2, 0]
        c12 = normal[0, 2] * normal[1, 0] - normal[0, 0] * normal[1, 2]
        c22 = normal[0, 0] * normal[1, 1] - normal[0, 1] * normal[1, 0]
        step_0 = (c00 * right[0] + c01 * right[1] + c02 * right[2]) / det
        step_1 = (c01 * right[0] + c11 * right[1] + c12 * right[2]) / det
        step_2 = (c02 * right[0] + c12 * right[1] + c22 * right[2]) / det
        position[0] += step_0
        position[1] += step_1
        position[2] += step_2
        if max(abs(step_0), abs(step_1), abs(step_2)) < 1e-10:
            return 1, normal, residual, jacobians
    return 0, normal, residual, jacobians
