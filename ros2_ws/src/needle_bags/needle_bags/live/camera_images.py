"""Camera images of the live view: choice of the next one, and drawing of the needle."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Without an answer from the tracker for this time, images are shown without the needle [s].
_ANSWER_TIMEOUT = 0.5
# Maximum number of exposures by which the tracker may lag behind.
_MAX_QUEUED = 6
# BGR. Sky blue and orange are also distinguishable with red-green colour blindness.
_SHAFT, _TIP, _TEXT = (240, 180, 60), (0, 160, 255), (255, 255, 255)
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
_RADIUS_PX = 9
_MAX_COORDINATE_PX = 1e4
_QUALITY = 80


class LatestImages:
    """Queue of one camera's images that await the tracker's answer."""

    def __init__(self) -> None:
        self._queue: deque[tuple[int, Image]] = deque(maxlen=_MAX_QUEUED)
        self._answered_at: float | None = None

    def add(self, stamp_ns: int, image: Image) -> None:
        """Add a grey image (H, W) exposed at `stamp_ns` [ns]."""
        self._queue.append((stamp_ns, image))

    def next(self, answered_ns: int | None, now: float) -> tuple[int, bool, Image] | None:
        """Return the image to show now; each image is returned at most once.

        Parameters
        ----------
        answered_ns : int or None
            Exposure time of the tracker's last answer [ns].
        now : float
            Steady time [s].

        Returns
        -------
        tuple or None
            Time of exposure [ns], whether it is the answered exposure, and the image.
        """
        if self._answered_at is None:
            self._answered_at = now
        for stamp_ns, image in tuple(self._queue):
            if stamp_ns == answered_ns:
                self._answered_at = now
                while self._queue.popleft()[0] != stamp_ns:
                    pass
                return stamp_ns, True, image
        if not self._queue or now - self._answered_at <= _ANSWER_TIMEOUT:
            return None
        stamp_ns, image = self._queue[-1]
        self._queue.clear()
        return stamp_ns, False, image


def draw_needle(grey: Image, shaft: Array, note: str) -> bytes:
    """Return a JPEG file of an image with shaft and tip drawn into it.

    Parameters
    ----------
    grey : ndarray of uint8, shape (height, width)
        The camera image.
    shaft : ndarray, shape (n, 2)
        Pixels of the shaft from the entry point to the tip; empty without a tip.
    note : str
        Line of text at the bottom.
    """
    picture = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    finite = shaft[np.all(np.isfinite(shaft), axis=-1)]
    if len(finite):
        points = np.clip(finite, -_MAX_COORDINATE_PX, _MAX_COORDINATE_PX) * (1 << _SHIFT)
        line = np.round(points).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [line], False, _SHAFT, 1, cv2.LINE_AA, _SHIFT)
        u, v = (int(part) for part in line[-1, 0])
        cv2.circle(picture, (u, v), _RADIUS_PX << _SHIFT, _TIP, 2, cv2.LINE_AA, _SHIFT)
    corner = (10, picture.shape[0] - 12)
    cv2.putText(picture, note, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.7, _TEXT, 2, cv2.LINE_AA)
    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    assert done
    return bytes(data)
