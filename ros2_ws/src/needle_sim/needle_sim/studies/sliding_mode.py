"""The published law that laws for points are held against: sliding mode control.

D. C. Rucker et al., "Sliding Mode Control of Steerable Needles", IEEE Trans. Robotics 29(5), 2013:
the base always turns at its greatest rate, towards the side on which the target lies of where the
bevel bends to. It knows no curvature and asks for no gain; it needs the tip's whole pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray


def sliding_mode_rate(target: ArrayLike, largest_rate: float) -> FloatArray:
    """Return the rotation of the base per inserted length, (...) [rad/m].

    Parameters
    ----------
    target : array_like, shape (..., 3)
        In the tip's frame, whose z is the heading and to whose -y the needle bends [m].
    largest_rate : float
        What it turns at [rad/m].
    """
    x, y, _ = np.moveaxis(np.asarray(target, dtype=float), -1, 0)
    return np.asarray(largest_rate * np.sign(np.arctan2(x, -y)))
