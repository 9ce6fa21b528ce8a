"""Exact motion of a needle, for comparison with the model of the controller."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm


def moved(
    pose: npt.NDArray[np.float64], length: float, turn: float, curvature: float
) -> npt.NDArray[np.float64]:
    """Return a pose, (4, 4), moved by [KC09] (2), with scipy's exponential."""
    x, z = curvature * length, turn
    twist = np.array([[0, -z, 0, 0], [z, 0, -x, 0], [0, x, 0, length], [0, 0, 0, 0.0]])
    return np.asarray(pose @ expm(twist))
