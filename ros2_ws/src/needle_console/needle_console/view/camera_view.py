"""Camera views with tip, shaft and target as JPEG, drawn only on request."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_console.view.snapshot import Array, Snapshot
from needle_tracker.optics.refraction import RefractedCamera

SIDES = ("left", "right")
# Minimum time between two drawings of a view [s].
PERIOD = 0.1
# A view is not shown if its image is older than this [s].
_MAX_AGE = 2.0

Image = NDArray[np.uint8]
# BGR, from the palette of Okabe and Ito.
_BLUE, _ORANGE, _WHITE = (178, 114, 0), (0, 159, 230), (255, 255, 255)
_WIDTH_PX = 640
_QUALITY = 80
_SUB_BITS = 4


class CameraView:
    """Views of both cameras; any thread may call the methods.

    All times are monotonic [s].

    Parameters
    ----------
    cameras : mapping of str to RefractedCamera
        Cameras by side; a side without a camera is shown without the needle.
    snapshot : callable
        Returns the newest state of the rig.
    """

    def __init__(
        self, cameras: Mapping[str, RefractedCamera], snapshot: Callable[[], Snapshot]
    ) -> None:
        self._cameras = cameras
        self._snapshot = snapshot
        self._lock = threading.Lock()
        self._images: dict[str, tuple[Image, float]] = {}
        self._jpegs: dict[str, tuple[bytes, float]] = {}

    def set_image(self, side: str, image: Image, now: float) -> None:
        """Set the newest grey image of a side, shape (height, width)."""
        with self._lock:
            self._images[side] = image, now

    def jpeg(self, side: str, now: float) -> bytes | None:
        """Return the newest view of a side as JPEG; None without a recent image."""
        with self._lock:
            image, arrival = self._images.get(side, (None, -math.inf))
            if image is None or now - arrival > _MAX_AGE:
                return None
            jpeg, drawn = self._jpegs.get(side, (b"", -math.inf))
        if now - drawn < PERIOD:
            return jpeg
        jpeg = draw_view(image, self._snapshot(), self._cameras.get(side))
        with self._lock:
            self._jpegs[side] = jpeg, now
        return jpeg


def draw_view(image: Image, snapshot: Snapshot, camera: RefractedCamera | None) -> bytes:
    """Return a camera image with the needle drawn into it.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        The camera image.
    snapshot : Snapshot
        State of the rig with tip, shaft and target point.
    camera : RefractedCamera or None
        Projects the points; if it is None or has another image size, nothing is drawn.

    Returns
    -------
    bytes
        A JPEG, at most 640 px wide.
    """
    height, width = image.shape
    scale = min(1.0, _WIDTH_PX / width)
    if scale < 1.0:
        size = (round(width * scale), round(height * scale))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    if camera is not None and (camera.camera.width, camera.camera.height) == (width, height):
        _draw_needle(picture, snapshot, camera, scale)
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return data.tobytes()


def _draw_needle(picture: Image, snapshot: Snapshot, camera: RefractedCamera, scale: float) -> None:
    shaft = snapshot.shaft
    if len(shaft) > 1:
        line = _pixels(camera.project(shaft), scale)
        for colour, thickness in ((_WHITE, 4), (_BLUE, 2)):
            cv2.polylines(picture, [line], False, colour, thickness, cv2.LINE_AA, _SUB_BITS)
    tip = snapshot.tip
    if tip is not None and snapshot.tip_lost_for == 0.0:
        _mark(picture, _pixels(camera.project(tip.position[None]), scale)[0], cv2.MARKER_CROSS)
    point = snapshot.controller.target_point_m if snapshot.controller is not None else None
    if point is not None:
        at = _pixels(camera.project(np.array([point])), scale)[0]
        _mark(picture, at, cv2.MARKER_DIAMOND)


def _pixels(points: Array, scale: float) -> NDArray[np.int32]:
    """Return pixel coordinates in OpenCV's fixed point, clipped to its range."""
    scaled = (np.nan_to_num(points, nan=-1.0) + 0.5) * scale - 0.5
    bounded = np.clip(scaled, -1e4, 1e4) * (1 << _SUB_BITS)
    return np.asarray(np.rint(bounded), np.int32)


def _mark(picture: Image, at: NDArray[np.int32], kind: int) -> None:
    position = (int(at[0]) >> _SUB_BITS, int(at[1]) >> _SUB_BITS)
    for colour, thickness in ((_WHITE, 4), (_ORANGE, 2)):
        cv2.drawMarker(picture, position, colour, kind, 18, thickness, cv2.LINE_AA)
