"""Keeps an estimate of s where the change of coordinates (6) can be inverted ([KC09] IV-A)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array


def saturate(
    linearized: npt.ArrayLike, curvature: npt.ArrayLike, margin: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Project s radially onto s2^2 + (s3 / kappa)^2 <= 1 - margin.

    The region is where a pitch and a roll within +-90 deg exist for s; s1 is free. In the
    coordinates (s2, s3 / kappa) it is a disc and the projection the closest point, as in the paper:
    [0, 1.5, 0] becomes [0, 1, 0] as the margin vanishes. The margin keeps cos(pitch) cos(roll) >=
    sqrt(margin), which the inverse of (7) divides by.

    Parameters
    ----------
    linearized : array_like, shape (..., 3)
        The linearized state s.
    curvature : array_like, shape (...)
        Curvature of the needle's path, kappa [1/m].
    margin : float
        In [0, 1).

    Returns
    -------
    saturated : ndarray, shape (..., 3)
        The same s where it was inside, its projection where not.
    changed : ndarray of bool, shape (...)
        Where it was projected.
    """
    linearized = np.asarray(linearized, dtype=float)
    s2, sine = linearized[..., 1], linearized[..., 2] / np.asarray(curvature, dtype=float)
    squared = s2 * s2 + sine * sine
    changed = np.asarray(squared > 1.0 - margin)
    scale = np.sqrt((1.0 - margin) / np.where(changed, squared, 1.0 - margin))
    saturated = linearized.copy()
    saturated[..., 1] *= scale
    saturated[..., 2] *= scale
    return saturated, changed
