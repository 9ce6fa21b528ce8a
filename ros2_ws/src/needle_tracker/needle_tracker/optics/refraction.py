"""Camera behind its refracting window: projection of points by Snell's law.

The window is a stack of plane-parallel media: air with the camera, layers such as a wall of
acrylic, then the body with the needle. A ray from the camera and its refracted continuations lie in
one plane with the normal of the window, so that refraction is a problem in that plane.

The compiled functions are for loops; `RefractedCamera` accepts arrays of any shape.
"""

# Compiled functions take plain numbers, one by one.
# ruff: noqa: PLR0917

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined
from needle_tracker.optics.calibration import Camera, StereoCalibration

Array = NDArray[np.float64]


_ITERATIONS = 40
_UNDISTORT_ITERATIONS = 12
_UNDISTORTED = 1e-9  # error of a converged inversion of the distortion, at unit focal length
_JACOBIAN_STEP = 1e-5  # step of the central differences [m], for a relative error of about 1e-8
_LAYERS = 29  # index of the first layer in a packed camera: thickness and refractive index


@inlined
def cross(one: Array, other: Array, result: Array) -> None:
    """Write the cross product of two vectors, shape (3,)."""
    result[0] = one[1] * other[2] - one[2] * other[1]
    result[1] = one[2] * other[0] - one[0] * other[2]
    result[2] = one[0] * other[1] - one[1] * other[0]


@inlined
def dot(one: Array, other: Array) -> float:
    """Return the scalar product of two vectors, shape (3,)."""
    product: float = one[0] * other[0] + one[1] * other[1] + one[2] * other[2]
    return product


def pack_camera(camera: Camera) -> Array:
    """Return the parameters of the projection as one array, for `project_point`."""
    window = camera.window
    height = float(window.height(camera.centre))
    # Point of the outer face closest to the camera.
    foot = window.point + (camera.centre - window.point - height * window.normal)
    return np.concatenate(
        [
            camera.T_optical_rig[:3, :3].reshape(-1),
            camera.T_optical_rig[:3, 3],
            foot,
            camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
            camera.distortion,
            [height, window.inside],
            window.normal,
            *([layer.thickness, layer.refractive_index] for layer in window.layers),
        ]
    )


@inlined
def _crossing(camera: Array, distance: float, depth: float) -> float:
    """Return the distance from the foot of the camera at which light crosses the outer face [m].

    Snell's law in the plane of incidence, with rho the desired distance and s = rho / sqrt(rho^2 +
    h^2) the sine in air: a layer displaces the light by t s / sqrt(n_i^2 - s^2), and in the last
    medium, of index n, the remaining distance r = D - rho - ... over the depth d requires s = n r /
    sqrt(r^2 + d^2). The difference of the two sides increases with rho and has one root in [0, D].

    Parameters
    ----------
    camera : ndarray
        Packed camera, from `pack_camera`.
    distance : float
        D: distance of the point from the foot of the camera, along the window [m].
    depth : float
        Depth of the point behind the outer face [m].
    """
    # The point is in the last medium.
    index, end = camera[25], len(camera)
    shallower = 0.0
    for i in range(_LAYERS, len(camera), 2):
        if depth <= camera[i]:
            index, end = camera[i + 1], i
            break
        depth -= camera[i]
        shallower += camera[i] / camera[i + 1]
    height = camera[24]
    low, high = 0.0, distance
    rho: float = distance * index * height / (index * height + (depth + index * shallower))
    for _ in range(_ITERATIONS):
        air2 = rho * rho + height * height
        air = math.sqrt(air2)
        sine, bend = rho / air, height * height / (air2 * air)
        farther = growth = 0.0
        for i in range(_LAYERS, end, 2):
            index2 = camera[i + 1] * camera[i + 1]
            square = index2 - sine * sine
            root = math.sqrt(square)
            farther += camera[i] * sine / root
            growth += camera[i] * index2 / (square * root)
        rest = distance - rho - farther
        body2 = rest * rest + depth * depth
        body = math.sqrt(body2)
        value = sine - index * rest / body
        slope = bend + index * depth * depth / (body2 * body) * (1.0 + growth * bend)
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
    return rho


@inlined
def _apparent_point(
    camera: Array, point_x: float, point_y: float, point_z: float
) -> tuple[float, float, float]:
    """Return the point of the outer face at which a point appears, in the optical frame [m]."""
    offset_x, offset_y, offset_z = point_x - camera[12], point_y - camera[13], point_z - camera[14]
    depth = -(camera[26] * offset_x + camera[27] * offset_y + camera[28] * offset_z)
    if depth > 0.0:
        along_x = offset_x + depth * camera[26]
        along_y = offset_y + depth * camera[27]
        along_z = offset_z + depth * camera[28]
        distance = math.sqrt(along_y * along_y + along_z * along_z + along_x * along_x)
        ratio = _crossing(camera, distance, depth) / distance if distance > 0.0 else 1.0
        point_x = camera[12] + along_x * ratio
        point_y = camera[13] + along_y * ratio
        point_z = camera[14] + along_z * ratio
    return (
        camera[0] * point_x + camera[1] * point_y + camera[2] * point_z + camera[9],
        camera[3] * point_x + camera[4] * point_y + camera[5] * point_z + camera[10],
        camera[6] * point_x + camera[7] * point_y + camera[8] * point_z + camera[11],
    )


@compiled
def apparent_points(camera: Array, points: Array, apparent: Array) -> None:
    """Write the points of the outer face at which points appear.

    Parameters
    ----------
    camera : ndarray
        Packed camera, from `pack_camera`.
    points : ndarray, shape (n, 3)
        Points in `rig` [m]; those in front of the window are not refracted.
    apparent : ndarray, shape (n, 3)
        Output: points in the optical frame [m].
    """
    for i in range(len(points)):
        apparent[i, 0], apparent[i, 1], apparent[i, 2] = _apparent_point(
            camera, points[i, 0], points[i, 1], points[i, 2]
        )


@compiled
def project_point(camera: Array, point: Array, pixel: Array) -> None:
    """Write the pixel at which a camera sees a point.

    Parameters
    ----------
    camera : ndarray
        Packed camera, from `pack_camera`.
    point : ndarray, shape (3,)
        Point in `rig` [m].
    pixel : ndarray, shape (2,)
        Output: pixel coordinates; NaN behind the camera.
    """
    x, y, z = _apparent_point(camera, point[0], point[1], point[2])
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


@inlined
def _refracted(
    camera: Array, along_x: float, along_y: float, along_z: float, index: float, direction: Array
) -> float:
    """Write the unit vector of a ray in a medium; return its component along the normal."""
    x, y, z = along_x / index, along_y / index, along_z / index
    steep = math.sqrt(1.0 - x * x - y * y - z * z)
    direction[0] = x - steep * camera[26]
    direction[1] = y - steep * camera[27]
    direction[2] = z - steep * camera[28]
    return steep


@compiled
def pixel_ray(camera: Array, pixel: Array, origin: Array, direction: Array) -> None:
    """Write the refracted ray of a pixel.

    Parameters
    ----------
    camera : ndarray
        Packed camera, from `pack_camera`.
    pixel : ndarray, shape (2,)
        Pixel coordinates.
    origin, direction : ndarray, shape (3,)
        Output: the point of the inner face of the window in `rig` [m] and the unit vector into the
        body; NaN if the pixel does not see the window or the distortion has no inverse.
    """
    k1, k2, p1, p2, k3 = camera[19], camera[20], camera[21], camera[22], camera[23]
    distorted_x = (pixel[0] - camera[17]) / camera[15]
    distorted_y = (pixel[1] - camera[18]) / camera[16]
    x, y = distorted_x, distorted_y
    miss_x = miss_y = 0.0
    for _ in range(_UNDISTORT_ITERATIONS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        miss_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - distorted_x
        miss_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - distorted_y
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
    air_x = camera[0] * x + camera[3] * y + camera[6] * z
    air_y = camera[1] * x + camera[4] * y + camera[7] * z
    air_z = camera[2] * x + camera[5] * y + camera[8] * z
    inwards = -(camera[26] * air_x + camera[27] * air_y + camera[28] * air_z)
    if not (inwards > 0.0 and abs(miss_x) + abs(miss_y) < _UNDISTORTED):
        origin[:] = np.nan
        direction[:] = np.nan
        return
    # Snell's law: the component along the window, divided by the index of each medium.
    along_x = air_x + inwards * camera[26]
    along_y = air_y + inwards * camera[27]
    along_z = air_z + inwards * camera[28]
    reach = camera[24] / inwards
    origin[0] = camera[12] + reach * along_x
    origin[1] = camera[13] + reach * along_y
    origin[2] = camera[14] + reach * along_z
    for i in range(_LAYERS, len(camera), 2):
        steep = _refracted(camera, along_x, along_y, along_z, camera[i + 1], direction)
        for k in range(3):
            origin[k] += camera[i] / steep * direction[k]
    _refracted(camera, along_x, along_y, along_z, camera[25], direction)


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
        jacobian[:, axis] = (ahead - behind) / (2.0 * _JACOBIAN_STEP)


def project_optical(camera: Camera, points: Array) -> Array:
    """Project points of the optical frame to pixels, through a plumb_bob lens (Brown's model).

    Parameters
    ----------
    camera : Camera
        The camera.
    points : ndarray, shape (..., 3)
        Points in the camera's optical frame [m].

    Returns
    -------
    ndarray, shape (..., 2)
        Pixel coordinates (u right, v down, pixel centres at integers); NaN behind the camera.
    """
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    x, y = points[..., 0] / depth, points[..., 1] / depth
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    distorted = np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )
    matrix = camera.camera_matrix
    return np.asarray(distorted * matrix[[0, 1], [0, 1]] + matrix[:2, 2])


class RefractedCamera:
    """Projection between points of the body and pixels of one camera.

    Parameters
    ----------
    camera : Camera
        Calibrated camera in front of its window.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.packed = pack_camera(camera)

    def __eq__(self, other: object) -> bool:
        """Return whether both cameras project all points identically."""
        return isinstance(other, RefractedCamera) and self._identity == other._identity

    def __hash__(self) -> int:
        """Return the hash of size and parameters."""
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[int, int, bytes]:
        return self.camera.width, self.camera.height, self.packed.tobytes()

    @property
    def sideways(self) -> Array:
        """Unit vector in `rig`, shape (3,), perpendicular to needle axis and window normal.

        With z it spans the plane through the needle that faces this camera.
        """
        sideways = np.cross([0.0, 0.0, 1.0], self.camera.window.normal)
        return np.asarray(sideways / np.linalg.norm(sideways))

    def project(self, points: Array) -> Array:
        """Return the pixels of points.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; those in front of the window are not refracted.

        Returns
        -------
        ndarray, shape (..., 2)
            Pixel coordinates, also outside the image; NaN behind the camera.
        """
        return project_optical(self.camera, self.apparent_points(points))

    def apparent_points(self, points: Array) -> Array:
        """Return the points of the outer face at which points appear, in the optical frame.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; those in front of the window are not refracted.

        Returns
        -------
        ndarray, shape (..., 3)
            Points in the optical frame [m].
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        apparent = np.empty(points.shape)
        apparent_points(self.packed, points.reshape(-1, 3), apparent.reshape(-1, 3))
        return apparent

    def jacobian(self, point: Array) -> Array:
        """Return d(pixel)/d(point) [px/m], shape (2, 3), at one point in `rig` [m]."""
        jacobian = np.empty((2, 3))
        point_jacobian(self.packed, np.asarray(point, dtype=np.float64), jacobian)
        return jacobian


def stereo_views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    """Return the left and the right camera of a calibration."""
    return RefractedCamera(calibration.left), RefractedCamera(calibration.right)
