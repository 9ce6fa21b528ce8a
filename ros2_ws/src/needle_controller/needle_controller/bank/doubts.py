"""Reasons for which an estimate declares itself doubtful."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_mixture import L_CURVATURE, L_NOISE, L_SCALE
from needle_controller.model.arrays import Array

LARGEST_X_STD = 0.001
"""Standard deviation of x beyond which nothing is said of the plane [m]."""
LARGEST_UNEXPLAINED = 0.35
"""Share of the last ten tips or so that were outliers."""
LARGEST_NOISE = 3.0
"""Noise as a multiple of what is claimed."""
LARGEST_SLIP = 0.15
"""Distance of the insertion scale from 1."""
_AT_LIMIT = 0.03


def doubts_of(
    learned: Array,
    x_variance: Array,
    unexplained: Array,
    settings: FilterSettings,
) -> dict[str, npt.NDArray[np.bool_]]:
    """Return each reason for doubt with the needles that have it, shape (N,).

    Parameters
    ----------
    learned : ndarray, shape (N, LEARNED)
        What was learned, see `hypothesis_mixture`.
    x_variance : ndarray, shape (N,)
        Of the distance from the plane [m^2].
    unexplained : ndarray, shape (N,)
        Share of the last tips that were outliers.
    settings : FilterSettings
        What the curvature is kept to.
    """
    curvature = learned[:, L_CURVATURE] / settings.curvature
    least, most = settings.curvature_range
    return {
        "x is not known to 1 mm": x_variance > LARGEST_X_STD**2,
        "too many tips are outliers": unexplained > LARGEST_UNEXPLAINED,
        "tips are far noisier than claimed": learned[:, L_NOISE] > LARGEST_NOISE,
        "the needle does not go in as the stage does": np.abs(learned[:, L_SCALE] - 1.0)
        > LARGEST_SLIP,
        "the curvature is at its limit": (curvature < least + _AT_LIMIT)
        | (curvature > most - _AT_LIMIT),
    }
