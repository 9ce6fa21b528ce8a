"""Poses for a grid of curvatures, and what they say together."""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.observers.pose_settings import coordinate_covariance, turned_cross


@dataclasses.dataclass(frozen=True)
class GridPoseCovariance:
    """Computes the covariance of an estimate when it is asked for.

    Attributes
    ----------
    start : ndarray, shape (..., 6, 6)
        Covariance of the likeliest start: position, body rotation vector.
    start_rotation : ndarray, shape (..., 3, 3)
        Its orientation.
    shift, turned : ndarray, shapes (..., 3), (..., 3, 3)
        The motion since the start, in its axes, at the likeliest curvature.
    weights : ndarray, shape (..., G)
        How likely each curvature is.
    position, rotation : ndarray, shapes (..., G, 3), (..., G, 3, 3)
        The pose now for each.
    mean_rotation : ndarray, shape (..., 3, 3)
        The orientation that is given out.
    """

    start: Array
    start_rotation: Array
    shift: Array
    turned: Array
    weights: Array
    position: Array
    rotation: Array
    mean_rotation: Array

    def __call__(self) -> Array:
        """Return the covariance of the coordinates: of the start, carried on, and of kappa."""
        carry = np.zeros((*self.shift.shape[:-1], 6, 6))
        carry[..., :3, :3] = np.eye(3)
        carry[..., :3, 3:] = turned_cross(self.start_rotation, self.shift)
        carry[..., 3:, 3:] = np.swapaxes(self.turned, -1, -2)
        within = carry @ self.start @ np.swapaxes(carry, -1, -2)
        centre = np.sum(self.weights[..., None] * self.position, axis=-2, keepdims=True)
        off = np.swapaxes(self.mean_rotation, -1, -2)[..., None, :, :] @ self.rotation
        turn = 0.5 * np.stack(
            [
                off[..., 2, 1] - off[..., 1, 2],
                off[..., 0, 2] - off[..., 2, 0],
                off[..., 1, 0] - off[..., 0, 1],
            ],
            axis=-1,
        )
        apart = np.concatenate([self.position - centre, turn], axis=-1)
        weighted = self.weights[..., None] * apart
        whole = within + np.swapaxes(weighted, -1, -2) @ apart
        return coordinate_covariance(
            whole[..., :3, :3], whole[..., :3, 3:], whole[..., 3:, 3:], self.mean_rotation
        )


def nearest_rotation(moment: Array) -> Array:
    """Return the rotation R that maximises trace(R^T moment), shape (..., 3, 3)."""
    u, _, vt = np.linalg.svd(moment)
    sign = np.linalg.det(u) * np.linalg.det(vt)
    u[..., :, 2] *= sign[..., None]
    return np.asarray(u @ vt)


def pick(values: Array, index: npt.NDArray[np.int64]) -> Array:
    """Return the rows of a grid axis that an index names: (..., G, *) by (...)."""
    spare = values.ndim - index.ndim - 1
    shaped = index.reshape(*index.shape, 1, *([1] * spare))
    picked = np.take_along_axis(values, shaped, axis=index.ndim)
    return np.asarray(np.squeeze(picked, axis=index.ndim))


def apply(matrix: Array, vector: Array) -> Array:
    """Return matrices times vectors, (..., i, j) by (..., j)."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))
