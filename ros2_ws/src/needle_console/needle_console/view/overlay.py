"""Camera views with tip and shaft drawn in, as JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from needle_console.view.snapshot import Array, Snapshot
from needle_tracker.optics.refraction import RefractedCamera

Image = NDArray[np.uint8]
# BGR, of Okabe and Ito's palette.
_BLUE, _ORANGE, _WHITE = (178, 114, 0), (0, 159, 230), (255, 255, 255)
_WIDTH_PX = 640
_QUALITY = 80
_SUB_BITS = 4


def draw_view(image: Image, snapshot: Snapshot, camera: RefractedCamera | None) -> bytes:
    """Return a camera's view with the needle drawn in.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width)
        As the camera sent it.
    snapshot : Snapshot
        Tip, shaft and target point.
    camera : RefractedCamera or None
        Where points are seen; None: nothing is drawn in, as where the image has another size.

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
    """Return pixel coordinates in OpenCV's fixed point, kept where its arithmetic holds them."""
    scaled = (np.nan_to_num(points, nan=-1.0) + 0.5) * scale - 0.5
    bounded = np.clip(scaled, -1e4, 1e4) * (1 << _SUB_BITS)
    return np.asarray(np.rint(bounded), np.int32)


def _mark(picture: Image, at: NDArray[np.int32], kind: int) -> None:
    where = (int(at[0]) >> _SUB_BITS, int(at[1]) >> _SUB_BITS)
    for colour, thickness in ((_WHITE, 4), (_ORANGE, 2)):
        cv2.drawMarker(picture, where, colour, kind, 18, thickness, cv2.LINE_AA)
