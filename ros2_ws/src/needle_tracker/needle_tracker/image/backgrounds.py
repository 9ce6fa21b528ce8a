"""Which pair shows what stands behind the needle: the latest without it, or the one with least.

Without the insertion that is the first pair. What has come since is the needle's.
"""

from __future__ import annotations

import numpy as np

from needle_tracker.image.background import LEAST_NEW, Background
from needle_tracker.image.detection import Image
from needle_tracker.optics.refraction import RefractedCamera

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
        self._least_new = LEAST_NEW * needle_width
        self._kept: Pair | None = None
        self._insertion = np.inf
        if empty is not None:
            self.see(empty, 0.0)

    def see(self, images: tuple[Image, Image], insertion: float | None) -> Pair:
        """Take in a pair; return what stands behind its needle.

        Parameters
        ----------
        images : pair of ndarray of uint8, shape (height, width)
            Left and right.
        insertion : float or None
            Length of needle in the phantom [m].
        """
        if insertion is not None and insertion <= max(self._insertion, self._hole_clearance):
            self._keep(images, empty=insertion <= self._hole_clearance)
            self._insertion = insertion
        elif self._kept is None:
            self._keep(images, empty=False)
        assert self._kept is not None
        return self._kept

    def _keep(self, images: tuple[Image, Image], *, empty: bool) -> None:
        left, right = (
            self._background(view, image, empty=empty)
            for view, image in zip(self._views, images, strict=True)
        )
        self._kept = left, right

    def _background(self, view: RefractedCamera, image: Image, *, empty: bool) -> Background:
        entry, beyond = view.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, self._least_new]]))
        least_new = None if empty else float(np.linalg.norm(beyond - entry))
        # A camera's driver may use the array again.
        return Background(image.copy(), entry, least_new)
