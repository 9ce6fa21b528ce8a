"""What stands behind the needle: an image from before it came, and what differs from that.

Graph paper, print or weave has lines as dark and whole as a needle, and one of them that runs along
its end hides where that is. What was there before the needle takes them away.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

_LEVEL = 128.0
"""Grey level of what does not differ."""
# Of rows and columns: so much is looked at to tell which image is rougher, and over so many pixels.
_EVERY, _LAG = 8, 2
_LEAST_LEVEL = 1.0


class Background:
    """The view of one camera before the needle was where it is.

    Parameters
    ----------
    before : ndarray of uint8, shape (height, width)
        An image with less of the needle, or none; kept, not copied.
    entry : ndarray, shape (2,)
        Where the camera sees the entry [px].
    reached : float
        So far from that the needle was there already [px]; 0: it was not.
    """

    def __init__(self, before: Image, entry: Array, reached: float) -> None:
        self._before = before
        self._entry = entry
        self._reached = reached
        self._mean = max(_mean(before), _LEAST_LEVEL)
        self._image: Image | None = None
        self._difference: Image | None = None
        self._inside: NDArray[np.bool_] | None = None

    def difference(self, image: Image) -> Image | None:
        """Return what an image has beside the background; None where it is smoother as it is.

        Before a plain floor the difference has nothing less but more noise; and after the camera
        was touched it has everything twice.

        Parameters
        ----------
        image : ndarray of uint8, shape (height, width)
            Of the same camera, as a whole as much brighter or darker as it likes; what was made of
            the same array before is kept.
        """
        if image is not self._image:
            # Lamps flicker: the floor, most of the image, tells by how much.
            gain = _mean(image) / self._mean
            difference = np.asarray(
                cv2.addWeighted(image, 1.0, self._before, -gain, _LEVEL), dtype=np.uint8
            )
            smoother = _roughness(difference) < _roughness(image)
            self._image, self._difference = image, difference if smoother else None
        return self._difference

    def joined(self, whole: Image, new: Image) -> Image:
        """Return a map of the needle from that of the image and that of the difference.

        Where the needle was before, it may hardly differ.

        Parameters
        ----------
        whole, new : ndarray of uint8, shape (height, width)
            Maps of the image and of the difference.
        """
        if self._inside is None:
            rows, columns = np.ogrid[: whole.shape[0], : whole.shape[1]]
            off = np.hypot(columns - self._entry[0], rows - self._entry[1])
            self._inside = np.asarray(off < self._reached)
        return np.where(self._inside, np.maximum(whole, new), new)

    @property
    def is_empty(self) -> bool:
        """Whether there was no needle at all."""
        return self._reached <= 0.0

    def is_seam(self, point: Array, room: float) -> bool:
        """Return whether a point is where both maps meet: a line that ends there may go on.

        Parameters
        ----------
        point : ndarray, shape (2,)
            In the image [px].
        room : float
            How near is near [px].
        """
        off = float(np.hypot(*(point - self._entry)))
        return not self.is_empty and abs(off - self._reached) < room


def _mean(image: Image) -> float:
    return float(image[::_EVERY].mean())


def _roughness(image: Image) -> float:
    """Return how much brightness varies over a few pixels [grey levels squared]."""
    rows, columns = image[::_EVERY].astype(np.float32), image[:, ::_EVERY].astype(np.float32)
    across, down = rows[:, _LAG:] - rows[:, :-_LAG], columns[_LAG:] - columns[:-_LAG]
    return float(np.mean(across * across) + np.mean(down * down))
