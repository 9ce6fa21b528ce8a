"""A covariance as something to look at: the ellipsoid that holds the place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of a normal distribution in space, 95 % lie within so many sigmas: chi-squared of three degrees.
SIGMAS = 2.7955


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Return the ellipsoid that holds 95 % of a normal distribution.

    Parameters
    ----------
    covariance : ndarray, shape (3, 3)
        Of a place [m^2].

    Returns
    -------
    axes : ndarray, shape (3, 3)
        Directions of the half axes as columns, right-handed.
    lengths : ndarray, shape (3,)
        Of the half axes [m].
    """
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:
        axes = axes * [1.0, 1.0, -1.0]
    return axes, SIGMAS * np.sqrt(np.maximum(variances, 0.0))
