"""The simulation's own idea of a window: flat faces between a camera in air and the phantom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedWindow:
    """Parallel faces, with a layer between each and the next, and the phantom behind the last.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        Unit vector in `rig`, towards the camera.
    outer : float
        Of the outer face: the coordinate along the normal, from `rig`'s origin [m].
    thicknesses : tuple of float
        Of the layers, from outside inwards [m].
    indices : tuple of float
        Refractive indices of the layers, and last of the phantom.
    """

    normal: FloatArray
    outer: float
    thicknesses: tuple[float, ...]
    indices: tuple[float, ...]

    @property
    def inner(self) -> float:
        """Coordinate along the normal of the inner face, where the phantom begins [m]."""
        return self.outer - sum(self.thicknesses)

    def height(self, points: ArrayLike) -> FloatArray:
        """Return the coordinates (...,) along the normal of points (..., 3) in `rig` [m]."""
        return np.asarray(points, dtype=np.float64) @ self.normal

    def passed(self, height: FloatArray) -> list[FloatArray]:
        """Return how much of each layer, and of the phantom, is above points of that height [m]."""
        left = np.maximum(self.outer - height, 0.0)
        lengths = []
        for thickness in self.thicknesses:
            lengths.append(np.minimum(left, thickness))
            left = left - lengths[-1]
        return [*lengths, left]

    @property
    def sideways(self) -> FloatArray:
        """Unit vector along the faces and across z, shape (3,)."""
        across = np.cross([0.0, 0.0, 1.0], self.normal)
        return np.asarray(across / np.linalg.norm(across))
