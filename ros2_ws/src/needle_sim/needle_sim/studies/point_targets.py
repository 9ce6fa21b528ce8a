"""Points for the needles of a study to go to."""

from __future__ import annotations

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.studies import study_noise

NEAREST, FARTHEST = 0.060, 0.120
"""How far ahead of their starts the points lie [m]."""
CURVATURE_SHARE = 0.6
"""Share of the needle's curvature that the arc from the true start to the point takes at most. What
a hand can aim at is more; but over its first centimetres a needle does not know yet how it lies."""


def random_targets(starts: FloatArray, curvature: float, seed: int) -> FloatArray:
    """Return a point for each needle that it can reach from where it really starts.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    curvature : float
        Of a needle's path [1/m].
    seed : int
        Of all randomness.

    Returns
    -------
    ndarray, shape (N, 3)
        Distance ahead uniform, the place across it uniform within what can be reached [m].
    """
    count = len(starts)
    share = study_noise.uniform(seed, study_noise.TARGET, 0, 0, count).astype(np.float64)
    ahead = NEAREST + (FARTHEST - NEAREST) * share[:, 0]
    tightest = CURVATURE_SHARE * curvature
    # On an arc of that curvature: ahead^2 = across (2 / tightest - across).
    widest = (1.0 - np.sqrt(1.0 - (tightest * ahead) ** 2)) / tightest
    across, around = widest * np.sqrt(share[:, 1]), 2.0 * np.pi * share[:, 2]
    up, aside = across * np.cos(around), across * np.sin(around)
    x, pitch, _ = starts.T
    cosine, sine = np.cos(pitch), np.sin(pitch)
    return np.stack([x + cosine * up + sine * ahead, aside, cosine * ahead - sine * up], axis=-1)
