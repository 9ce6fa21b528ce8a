"""Which pair shows what stands behind the needle: the latest without it, or the one with least.

Without the insertion that is the first pair: what has come since is the needle's.
"""

from __future__ import annotations

import numpy as np

from needle_tracker.image.background import Background
from needle_tracker.image.detection import Image
from needle_tracker.optics.refraction import RefractedCamera

_ROOM = 0.5e-3  # the needle may have been so much farther than the insertion says [m]
_LEAST_NEW = 3.0  # so much of the needle must be new for its end to be plain of it [widths]

Pair = tuple[Background, Background]


class Backgrounds:
    """Keeps the latest pair without needle; while there is none, that with the least of it.

    What another insertion left holds on: where it no longer fits, the image itself is smoother than
    what differs, and counts.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    hole_clearance : float
        Radius around the entry that is not looked at: so short a needle is none [m].
    needle_width : float
        The needle's diameter [m].
    empty : pair of ndarray of uint8, shape (height, width), or None
        Left and right image without needle, to begin with.
    """

    def __init__(
        self,
        views: tuple[RefractedCamera, RefractedCamera],
        hole_clearance: float,
        needle_width: float,
        empty: tuple[Image, Image] | None,
    ) -> None:
        self._views = views
        self._hole_clearance = hole_clearance
        self._least_new = _LEAST_NEW * needle_width
        self._kept: Pair | None = None
        self._insertion = np.inf
        if empty is not None:
            self.see(empty, 0.0)

    def see(self, images: tuple[Image, Image], insertion: float | None) -> Pair | None:
        """Take in a pair; return what stands behind its needle, None where that is not known.

        Parameters
        ----------
        images : pair of ndarray of uint8, shape (height, width)
            Left and right.
        insertion : float or None
            Length of needle in the phantom [m].
        """
        if insertion is not None and insertion <= max(self._insertion, self._hole_clearance):
            reached = 0.0 if insertion <= self._hole_clearance else insertion + _ROOM
            self._kept = self._backgrounds(images, reached)
            self._insertion = insertion
        elif insertion is None and self._kept is None:
            self._kept = self._backgrounds(images, None)
        if self._kept is None or self._kept[0].is_empty or not self._kept[0].is_known:
            return self._kept
        if insertion is None or insertion < self._insertion + self._least_new:
            return None
        return self._kept

    def _backgrounds(self, images: tuple[Image, Image], reached: float | None) -> Pair:
        left, right = (
            self._background(view, image, reached)
            for view, image in zip(self._views, images, strict=True)
        )
        return left, right

    def _background(self, view: RefractedCamera, image: Image, reached: float | None) -> Background:
        def along(depth: float) -> float:
            return float(np.linalg.norm(view.project(np.array([0.0, 0.0, depth])) - entry))

        entry = view.project(np.zeros(3))
        # A camera's driver may use the array again.
        return Background(
            image.copy(),
            entry,
            None if reached is None else along(reached),
            along(self._least_new),
        )
