"""Camera behind its refracting window: projection of points by Snell's law.

The window is a stack of plane-parallel media: air with the camera, layers such as a wall of
acrylic, then the body with the needle. A ray from the camera and its continuations are in one plane
with the normal of the window, so that refraction is a problem in that plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.calibration import Camera, StereoCalibration
from needle_tracker.optics.compiled_projection import pack_camera, point_jacobian, see_through

Array = NDArray[np.float64]


def distort(points: Array, distortion: Array) -> Array:
    """Apply plumb_bob distortion (Brown's model, as in OpenCV and CameraInfo).

    Parameters
    ----------
    points : ndarray, shape (..., 2)
        Ideal image points at unit focal length [-].
    distortion : ndarray, shape (5,)
        k1, k2, p1, p2, k3.

    Returns
    -------
    ndarray, shape (..., 2)
        Distorted points at unit focal length [-].
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def project_optical(camera: Camera, points: Array) -> Array:
    """Project points of the optical frame to pixels.

    Parameters
    ----------
    camera : Camera
        The camera.
    points : ndarray, shape (..., 3)
        In the camera's optical frame [m].

    Returns
    -------
    ndarray, shape (..., 2)
        Pixel coordinates (u right, v down, pixel centres at integers); NaN behind the camera.
    """
    depth = np.where(points[..., 2] > 0.0, points[..., 2], np.nan)
    distorted = distort(points[..., :2] / depth[..., None], camera.distortion)
    matrix = camera.camera_matrix
    return distorted * matrix[[0, 1], [0, 1]] + matrix[:2, 2]


class RefractedCamera:
    """Projection between points of the body and pixels of one camera.

    Parameters
    ----------
    camera : Camera
        Calibrated camera, before its window.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.packed = pack_camera(camera)

    def __eq__(self, other: object) -> bool:
        """Return whether both cameras project all points alike."""
        return isinstance(other, RefractedCamera) and self._identity == other._identity

    def __hash__(self) -> int:
        """Return the hash of size and parameters."""
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[int, int, bytes]:
        return self.camera.width, self.camera.height, self.packed.tobytes()

    @property
    def sideways(self) -> Array:
        """Unit vector in `rig`, shape (3,), across the needle's axis and the window's normal.

        With z it spans the plane through the needle that faces this camera.
        """
        sideways = np.cross([0.0, 0.0, 1.0], self.camera.window.normal)
        return np.asarray(sideways / np.linalg.norm(sideways))

    def project(self, points: Array) -> Array:
        """Return the pixels of points.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; those before the window are not refracted.

        Returns
        -------
        ndarray, shape (..., 2)
            Pixel coordinates, also outside the image; NaN behind the camera.
        """
        return project_optical(self.camera, self.seen_through(points))

    def seen_through(self, points: Array) -> Array:
        """Return the points of the outer face at which points appear, in the optical frame.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; those before the window are not refracted.

        Returns
        -------
        ndarray, shape (..., 3)
            Points of the optical frame [m].
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        seen = np.empty(points.shape)
        see_through(self.packed, points.reshape(-1, 3), seen.reshape(-1, 3))
        return seen

    def jacobian(self, point: Array) -> Array:
        """Return d(pixel)/d(point) [px/m], shape (2, 3), at one point in `rig` [m]."""
        jacobian = np.empty((2, 3))
        point_jacobian(self.packed, np.asarray(point, dtype=np.float64), jacobian)
        return jacobian


def stereo_views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    """Return the left and the right camera of a calibration."""
    return RefractedCamera(calibration.left), RefractedCamera(calibration.right)
