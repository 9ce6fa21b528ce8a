"""Way of the tip and shape of the shaft, from where the tip was at each insertion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Points along the way are so far apart at least, in insertion [m].
_SPACING = 1e-3
# A needle that is out to here begins a new way [m].
_OUT = 5e-4


class ShaftTrail:
    """Keeps where the tip was on its way in; behind the tip the shaft lies where the tip went.

    The way begins at the entry point, the origin of `rig`.
    """

    def __init__(self) -> None:
        self._insertions = [0.0]
        self._places = [np.zeros(3)]

    @property
    def path(self) -> Array:
        """Way of the tip in `rig`, from the entry on [m], shape (n, 3)."""
        return np.array(self._places)

    def add(self, insertion: float, place: Array) -> None:
        """Take where the tip is.

        Parameters
        ----------
        insertion : float
            Of the needle [m].
        place : ndarray, shape (3,)
            The tip in `rig` [m].
        """
        if insertion < _OUT:
            del self._insertions[1:], self._places[1:]
        elif insertion >= self._insertions[-1] + _SPACING:
            self._insertions.append(insertion)
            self._places.append(np.array(place))

    def shaft(self, insertion: float, tip: Array) -> Array:
        """Return the shaft of a needle that is so far in, to its tip.

        Parameters
        ----------
        insertion : float
            Of the needle [m]; less than it was: it is drawn back along its way.
        tip : ndarray, shape (3,)
            In `rig` [m].

        Returns
        -------
        ndarray, shape (n, 3)
            Points in `rig` from the entry to the tip [m].
        """
        behind = [
            place
            for at, place in zip(self._insertions, self._places, strict=True)
            if at < max(insertion - 0.5 * _SPACING, _OUT)
        ]
        return np.array([*behind, tip])
