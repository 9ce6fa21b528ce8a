"""A camera that looks through its window: Snell's law, both ways.

The window is a stack of plane-parallel media: air with the camera, layers such as a wall of
acrylic, then the body with the needle. A ray from the camera and its continuations lie in one plane
with the window's normal, so that both directions reduce to that plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.optics.calibration import Camera, StereoCalibration
from needle_tracker.optics.camera_model import project_optical
from needle_tracker.optics.compiled_projection import pack_camera, see_through

Array = NDArray[np.float64]

_JACOBIAN_STEP = 1e-5  # [m]: central differences are then good to about 1e-8 relative


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
        """Return whether both have the same image of everything."""
        return isinstance(other, RefractedCamera) and self._identity == other._identity

    def __hash__(self) -> int:
        """Return what is equal for equal cameras."""
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[int, int, bytes]:
        return self.camera.width, self.camera.height, self.packed.tobytes()

    @property
    def sideways(self) -> Array:
        """Unit vector in `rig`, shape (3,), across the needle's axis and the window's normal.

        With the axis, z, it spans the plane through the needle's way that faces this camera.
        """
        sideways = np.cross([0.0, 0.0, 1.0], self.camera.window.normal)
        return np.asarray(sideways / np.linalg.norm(sideways))

    def project(self, points: Array) -> Array:
        """Return the pixels at which points are seen.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; before the window they are seen straight.

        Returns
        -------
        ndarray, shape (..., 2)
            Pixel coordinates, also outside the image; NaN behind the camera.
        """
        return project_optical(self.camera, self.seen_through(points))

    def seen_through(self, points: Array) -> Array:
        """Return where points are seen on the outer face, in the optical frame: whatever the lens.

        Parameters
        ----------
        points : ndarray, shape (..., 3)
            Points in `rig` [m]; those before the window are seen straight.

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
        steps = _JACOBIAN_STEP * np.concatenate([np.eye(3), -np.eye(3)])
        pixels = self.project(point + steps)
        return np.asarray((pixels[:3] - pixels[3:]).T / (2.0 * _JACOBIAN_STEP))


def stereo_views(calibration: StereoCalibration) -> tuple[RefractedCamera, RefractedCamera]:
    """Return the left and the right camera of a calibration."""
    return RefractedCamera(calibration.left), RefractedCamera(calibration.right)
