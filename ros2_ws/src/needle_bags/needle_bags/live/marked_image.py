"""A camera's image with shaft and tip drawn in, as JPEG."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# OpenCV's order is blue, green, red. Sky blue and orange differ also to who sees no red or green.
_SHAFT, _TIP, _TEXT = (240, 180, 60), (0, 160, 255), (255, 255, 255)
_SHIFT = 4  # sub-pixel drawing: OpenCV takes fixed-point numbers
_RADIUS_PX = 9
_FAR_PX = 1e4
_QUALITY = 80


def marked_image(grey: Image, shaft: Array, note: str) -> bytes:
    """Return an image for a person to look at.

    Parameters
    ----------
    grey : ndarray of uint8, shape (height, width)
        What the camera saw.
    shaft : ndarray, shape (n, 2)
        Pixels of the shaft from the entry to the tip, around which a ring is drawn; none: no tip.
    note : str
        Line of text at the foot.

    Returns
    -------
    bytes
        A JPEG file.
    """
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    seen = shaft[np.all(np.isfinite(shaft), axis=-1)]
    if len(seen):
        points = np.clip(seen, -_FAR_PX, _FAR_PX) * (1 << _SHIFT)
        line = np.round(points).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [line], False, _SHAFT, 1, cv2.LINE_AA, _SHIFT)
        u, v = (int(part) for part in line[-1, 0])
        cv2.circle(picture, (u, v), _RADIUS_PX << _SHIFT, _TIP, 2, cv2.LINE_AA, _SHIFT)
    place = (10, picture.shape[0] - 12)
    cv2.putText(picture, note, place, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _TEXT, 2, cv2.LINE_AA)
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return bytes(data)
