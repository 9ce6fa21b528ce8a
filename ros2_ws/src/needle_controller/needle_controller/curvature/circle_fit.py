"""The plain least-squares circle through tips of pure insertion ([KC09] IV-B), for comparison."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array


def circle_curvature(tips: npt.ArrayLike) -> Array:
    """Return the curvature of the least-squares circle through tips ([KC09] IV-B), biased.

    The plane of the tips is that of their two largest principal axes, the circle the algebraic one
    that minimises the sum of (|p - c|^2 - r^2)^2. Noise along a short arc looks like curvature: at
    60 mm, +-1 mm, the result is a quarter too large. Use `curvature_fit`.

    Parameters
    ----------
    tips : array_like, shape (..., K, 3)
        Measured tips [m].

    Returns
    -------
    ndarray, shape (...)
        1 / r [1/m].
    """
    tips = np.asarray(tips, dtype=float)
    centred = tips - np.mean(tips, axis=-2, keepdims=True)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ np.swapaxes(axes[..., :2, :], -1, -2)
    squared = np.sum(flat**2, axis=-1)
    design = np.concatenate([2.0 * flat, np.ones_like(flat[..., :1])], axis=-1)
    transposed = np.swapaxes(design, -1, -2)
    solution = np.linalg.solve(transposed @ design, transposed @ squared[..., None])[..., 0]
    radius = np.sqrt(solution[..., 2] + np.sum(solution[..., :2] ** 2, axis=-1))
    return np.asarray(1.0 / radius)
