"""Exact motion along arcs on SE(3) ([KC09] (2)).

Over an advance the tip moves by exp((V1 l + V2 theta)^): in its own axes it rotates by the rotation
vector (kappa l, 0, theta) and moves along the corresponding helix. Leading axes broadcast.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array

SERIES_BELOW = 0.01


def cross_matrix(vector: npt.ArrayLike) -> Array:
    """Return v^ with v^ w = v x w, shape (..., 3, 3) of (..., 3)."""
    # numpy.cross would take several times as long, which shows in fits.
    vector = np.asarray(vector, dtype=float)
    matrix = np.zeros((*vector.shape[:-1], 3, 3))
    x, y, z = (vector[..., i] for i in range(3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -z, y
    matrix[..., 1, 0], matrix[..., 1, 2] = z, -x
    matrix[..., 2, 0], matrix[..., 2, 1] = -y, x
    return matrix


def rotation_exp(vector: npt.ArrayLike) -> Array:
    """Return the rotation of a rotation vector [rad], shape (..., 3, 3) of (..., 3)."""
    vector = np.asarray(vector, dtype=float)
    a, b, _ = rodrigues_factors(np.sum(vector * vector, axis=-1))
    matrix = cross_matrix(vector)
    return np.asarray(
        np.eye(3) + a[..., None, None] * matrix + b[..., None, None] * (matrix @ matrix)
    )


def left_jacobian(vector: npt.ArrayLike) -> Array:
    """Return J with exp((v + dv)^) = exp((J dv)^) exp(v^) to first order, (..., 3, 3)."""
    vector = np.asarray(vector, dtype=float)
    _, b, c = rodrigues_factors(np.sum(vector * vector, axis=-1))
    matrix = cross_matrix(vector)
    return np.asarray(
        np.eye(3) + b[..., None, None] * matrix + c[..., None, None] * (matrix @ matrix)
    )


@dataclasses.dataclass(frozen=True)
class RelativeMotion:
    """Pose at the end of a motion, in the axes of its start.

    Attributes
    ----------
    shift : ndarray, shape (..., 3)
        Position of the end [m].
    rotation : ndarray, shape (..., 3, 3)
        Orientation of the end.
    """

    shift: Array
    rotation: Array


def arc(length: npt.ArrayLike, turn: npt.ArrayLike, curvature: npt.ArrayLike) -> RelativeMotion:
    """Return the tip's motion over one advance; negative arguments reverse it.

    Parameters
    ----------
    length : array_like, shape (...)
        Inserted length l [m].
    turn : array_like, shape (...)
        Rotation theta of the tip about its axis over that length [rad].
    curvature : array_like, shape (...)
        kappa [1/m].
    """
    inserted, z, kappa = np.broadcast_arrays(
        np.asarray(length, dtype=float),
        np.asarray(turn, dtype=float),
        np.asarray(curvature, dtype=float),
    )
    x = kappa * inserted
    _, b, c = rodrigues_factors(x * x + z * z)
    shift = np.stack([c * x * z, -b * x, 1.0 - c * x * x], axis=-1) * inserted[..., None]
    return RelativeMotion(shift, rotation_exp(np.stack([x, np.zeros_like(x), z], axis=-1)))


def rodrigues_factors(squared: Array) -> tuple[Array, Array, Array]:
    """Return Rodrigues' factors sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 for a^2."""
    q = np.asarray(squared, dtype=float)
    small = q < SERIES_BELOW
    safe = np.where(small, 1.0, q)
    angle = np.sqrt(safe)
    a = np.where(small, 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0)), np.sin(angle) / angle)
    b = np.where(
        small,
        0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0))),
        2.0 * (np.sin(0.5 * angle) / angle) ** 2,
    )
    c = np.where(
        small, (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0))) / 6.0, (1.0 - a) / safe
    )
    return a, b, c
