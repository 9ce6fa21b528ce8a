"""Background of the needle: an image from before it came, and what differs from that.

Graph paper, print or weave has lines as dark and whole as a needle, and one of them that runs along
its end hides where that is. What was there before the needle takes them away.
"""

from __future__ import annotations

from functools import lru_cache

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
SURE = 128
"""Of 255: so much of a map is needle."""
LEAST_NEW = 3.0
"""So much of the needle must be new for its end to be plain of it [widths]."""


class Background:
    """The view of one camera before the needle was where it is.

    Parameters
    ----------
    before : ndarray of uint8, shape (height, width)
        An image with less of the needle, or none; kept, not copied.
    entry : ndarray, shape (2,)
        Where the camera sees the entry [px].
    least_new : float or None
        So much of the needle must be new for its end to be plain of it [px]; None: all is new.

    Attributes
    ----------
    before : ndarray of uint8, shape (height, width)
        As given.
    """

    def __init__(self, before: Image, entry: Array, least_new: float | None) -> None:
        self.before = before
        self._least_new = least_new
        self._mean = max(_mean(before), _LEAST_LEVEL)
        self._image: Image | None = None
        self._difference: Image | None = None
        self._away = _distances(before.shape, *map(float, entry))
        self._entry = entry
        self._seam: float | None = None

    def difference(self, image: Image) -> Image | None:
        """Return what an image has beside the background; None where the image itself says more.

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
                cv2.addWeighted(image, 1.0, self.before, -gain, _LEVEL), dtype=np.uint8
            )
            smoother = _roughness(difference) < _roughness(image)
            # The first pair is its own background: nothing is new, and the image says all.
            itself = not self.is_empty and np.array_equal(image, self.before)
            self._image, self._difference = image, difference if smoother and not itself else None
        return self._difference

    def joined(self, whole: Image, new: Image, before: Image, within: tuple[slice, slice]) -> Image:
        """Return a map of the needle from that of the image and that of the difference.

        Where the needle was before, it may hardly differ.

        Parameters
        ----------
        whole, new, before : ndarray of uint8, shape (height, width)
            Maps of the image, of the difference, and of the image before: that matters only where
            the difference is needle.
        within : pair of slice
            Rows and columns that hold all that is drawn of the first two.
        """
        away, part = self._away[within], (whole[within], new[within])
        self._seam = self._begin(away, *part, before[within])
        if self._seam is None:
            return whole
        joined = np.zeros_like(new)
        joined[within] = np.where(away < self._seam, np.maximum(*part), part[1])
        return joined

    def _begin(
        self, away: NDArray[np.float32], whole: Image, new: Image, before: Image
    ) -> float | None:
        """Return where the farthest part of the needle begins that is new; None where none is.

        What the difference shows and the image before showed better is a needle that has gone.
        """
        least = self._least_new or 0.0
        there = new > SURE
        distances = away[there].astype(np.int64)
        come = whole[there].astype(np.int64) - before[there]
        occupied = np.flatnonzero(np.bincount(distances))
        runs = np.split(occupied, np.flatnonzero(np.diff(occupied) > 0.5 * least) + 1)
        for run in reversed(runs):
            if len(run) and run[-1] - run[0] >= least:
                inside = (distances >= run[0]) & (distances <= run[-1])
                return float(run[0]) if come[inside].sum() > 0 else None
        return None

    @property
    def is_empty(self) -> bool:
        """Whether there was no needle at all."""
        return self._least_new is None

    def beyond_seam(self, point: Array) -> float:
        """Return how far a point is beyond where both maps meet; infinite where only one counts.

        A line that ends there may go on. What lies beyond has come since the image before.

        Parameters
        ----------
        point : ndarray, shape (2,)
            In the image [px].

        Returns
        -------
        float
            Positive where the map is that of the difference alone [px].
        """
        if self._seam is None:
            return np.inf if self.is_empty else -np.inf
        return float(np.hypot(*(point - self._entry))) - self._seam


@lru_cache(maxsize=2)
def _distances(shape: tuple[int, int], x: float, y: float) -> NDArray[np.float32]:
    """Return how far each pixel is from a point [px]; of one camera it stays the same."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.hypot((columns - x).astype(np.float32), (rows - y).astype(np.float32))


def _mean(image: Image) -> float:
    return float(image[::_EVERY].mean())


def _roughness(image: Image) -> float:
    """Return how much brightness varies over a few pixels [grey levels squared]."""
    rows, columns = image[::_EVERY], np.ascontiguousarray(image[:, ::_EVERY])
    return sum(
        cv2.norm(one, other, cv2.NORM_L2SQR) / one.size
        for one, other in (
            (rows[:, _LAG:], rows[:, :-_LAG]),
            (columns[_LAG:], columns[:-_LAG]),
        )
    )
