"""Camera behind its refracting window: projection of points by Snell's law.

The window is a stack of plane-parallel media: air with the camera, layers such as a wall of
acrylic, then the body with the needle. A ray from the camera and its refracted continuations lie in
one plane with the normal of the window, so that refraction is a problem in that plane.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from needle_core.compiled import compiled, inlined
from needle_tracker.optics.calibration import Camera, StereoCalibration

Array = NDArray[np.float64]

_ITERATIONS = 40
_JACOBIAN_STEP = 1e-5  # step of the central differences [m], for a relative error of about 1e-8
_LAYERS = 29  # index of the first layer in a packed camera: thickness and refractive index


def pack_camera(camera: Camera) -> Array:
    """Return the parameters of the projection as one array, for `_project`."""
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
def _project(camera: Array, points: Array, pixels: Array) -> None:
    """Write the pixels of points, through window and lens (plumb_bob, Brown's model).

    Parameters
    ----------
    camera : ndarray
        Packed camera, from `pack_camera`.
    points : ndarray, shape (n, 3)
        Points in `rig` [m].
    pixels : ndarray, shape (n, 2)
        Output: pixel coordinates; NaN behind the camera.
    """
    k1, k2, p1, p2, k3 = camera[19], camera[20], camera[21], camera[22], camera[23]
    for i in range(len(points)):
        x, y, z = _apparent_point(camera, points[i, 0], points[i, 1], points[i, 2])
        if not z > 0.0:
            pixels[i] = np.nan
            continue
        x /= z
        y /= z
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        distorted_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        distorted_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        pixels[i, 0] = camera[15] * distorted_x + camera[17]
        pixels[i, 1] = camera[16] * distorted_y + camera[18]


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
            Pixel coordinates (u right, v down, pixel centres at integers), also outside the image;
            NaN behind the camera.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        pixels = np.empty((*points.shape[:-1], 2))
        _project(self.packed, points.reshape(-1, 3), pixels.reshape(-1, 2))
        return pixels

    def jacobian(self, point: Array) -> Array:
        """Return d(pixel)/d(point) [px/m], shape (2, 3), at one point in `rig` [m]."""
        steps = _JACOBIAN_STEP * np.eye(3)
        ahead, behind = self.project(point + steps), self.project(point - steps)
        return np.asarray((ahead - behind).T / (2.0 * _JACOBIAN_STEP))


def stereo_views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    """Return the left and the right camera of a calibration."""
    return RefractedCamera(calibration.left), RefractedCamera(calibration.right)
