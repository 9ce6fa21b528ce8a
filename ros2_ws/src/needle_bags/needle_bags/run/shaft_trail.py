"""Path of the tip and shape of the shaft, from the tip positions during the insertion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Minimum distance between points of the path, in insertion depth [m].
_SPACING = 1e-3
# A needle withdrawn to this depth starts a new path [m].
_OUT = 5e-4


class ShaftTrail:
    """Path of the tip during the insertion, which the shaft follows.

    The path starts at the entry point, the origin of `rig`.

    Parameters
    ----------
    start : ndarray, optional
        Pose of the origin, shape (4, 4), to store a path of poses; by default the path stores
        positions.
    """

    def __init__(self, start: Array | None = None) -> None:
        self._insertions = [0.0]
        self._positions = [np.zeros(3) if start is None else start]

    @property
    def path(self) -> Array:
        """Path of the tip in `rig` from the entry point [m], shape (n, 3)."""
        return np.array(self._positions)

    @property
    def depth(self) -> float:
        """Insertion depth at the end of the path [m]."""
        return self._insertions[-1]

    def add(self, insertion: float, position: Array) -> None:
        """Add a tip position.

        Parameters
        ----------
        insertion : float
            Insertion depth [m].
        position : ndarray, shape (3,)
            Position of the tip in `rig` [m].
        """
        if insertion < _OUT:
            del self._insertions[1:], self._positions[1:]
        elif insertion >= self._insertions[-1] + _SPACING:
            self._insertions.append(insertion)
            self._positions.append(np.array(position))

    def shaft(self, insertion: float, tip: Array) -> Array:
        """Return the shaft of the needle.

        Parameters
        ----------
        insertion : float
            Insertion depth [m]; a withdrawn needle retreats along its path.
        tip : ndarray, shape (3,)
            Position of the tip in `rig` [m].

        Returns
        -------
        ndarray, shape (n, 3)
            Points in `rig` from the entry to the tip [m].
        """
        passed = [
            position
            for at, position in zip(self._insertions, self._positions, strict=True)
            if at < max(insertion - 0.5 * _SPACING, _OUT)
        ]
        return np.array([*passed, tip])
