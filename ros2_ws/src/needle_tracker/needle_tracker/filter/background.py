"""Which pair shows the background: the one with the least needle so far."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Pair = tuple[Image, Image]


class Background:
    """Keeps the pair with the least needle: by the insertion, else the first one.

    Parameters
    ----------
    reference : pair of ndarray of uint8, shape (height, width), or None
        Left and right image of the phantom without needle, to begin with.
    least_new : float
        Length of needle that must be new since a pair, or it says too little [m].
    """

    def __init__(self, reference: Pair | None, least_new: float) -> None:
        self._pair: Pair | None = None
        self._insertion: float | None = None
        self._least_new = least_new
        if reference is not None:
            self.see(reference, 0.0)

    def see(self, pair: Pair, insertion: float | None) -> Pair | None:
        """Take in a pair; return the pair that is its background, None where there is none.

        Parameters
        ----------
        pair : pair of ndarray of uint8, shape (height, width)
            Left and right.
        insertion : float or None
            Length of needle in the phantom [m].
        """
        before = math.inf if self._insertion is None else self._insertion
        less = insertion is not None and insertion <= max(before, 0.0)
        if self._pair is None or less:
            self._insertion = insertion
            # A camera's driver may use the array again.
            self._pair = pair[0].copy(), pair[1].copy()
            return None
        if insertion is not None and insertion - before < self._least_new:
            return None
        return self._pair
