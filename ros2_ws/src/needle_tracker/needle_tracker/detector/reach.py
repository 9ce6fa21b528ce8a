"""Reach of the needle, by its curvature, its longest insertion and how it enters."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Reach:
    """Physical reach of the needle.

    Attributes
    ----------
    curvature : float
        Largest curvature of its path [1/m].
    entry_angle : float
        Largest angle of its heading to z at the entry [rad].
    hole_tolerance : float
        Largest offset of its path at the entry [m].
    length : float
        Longest insertion [m].
    """

    curvature: float
    entry_angle: float
    hole_tolerance: float
    length: float

    def shortest_chord(self, insertion: float) -> float:
        """Return the least distance of tip and entry [m] after `insertion` [m] along one arc."""
        half_turn = min(0.5 * self.curvature * insertion, math.pi / 2)
        return 2.0 * math.sin(half_turn) / self.curvature if self.curvature > 0.0 else insertion

    def chord_angle(self, distance: Array) -> Array:
        """Return the largest angle to z [rad] of a point of the needle at `distance` [m]."""
        turned = np.arcsin(np.clip(0.5 * self.curvature * distance, 0.0, 1.0))
        hole = np.arctan2(self.hole_tolerance, distance)
        return np.asarray(self.entry_angle + turned + hole)
