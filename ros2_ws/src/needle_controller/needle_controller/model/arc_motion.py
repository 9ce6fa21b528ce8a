"""Exact motion along arcs on SE(3), and its derivative by the curvature ([KC09] (2)).

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
    """End of a motion in the axes of its start, and its derivative by the curvature.

    Attributes
    ----------
    shift : ndarray, shape (..., 3)
        Position of the end [m].
    rotation : ndarray, shape (..., 3, 3)
        Orientation of the end.
    shift_slope : ndarray, shape (..., 3)
        d shift / d curvature [m^2].
    rotation_slope : ndarray, shape (..., 3)
        The end turns by the rotation vector `rotation_slope` d(curvature), in its own axes [m].
    """

    shift: Array
    rotation: Array
    shift_slope: Array
    rotation_slope: Array


def arc(length: npt.ArrayLike, turn: npt.ArrayLike, curvature: npt.ArrayLike) -> RelativeMotion:
    """Return the tip's motion over one advance; negative arguments reverse it.

    Parameters
    ----------
    length : array_like, shape (...)
        Inserted length l [m].
    turn : array_like, shape (...)
        Rotation theta of the tip about its axis over it [rad].
    curvature : array_like, shape (...)
        kappa [1/m].
    """
    inserted, z, kappa = np.broadcast_arrays(
        np.asarray(length, dtype=float),
        np.asarray(turn, dtype=float),
        np.asarray(curvature, dtype=float),
    )
    x = kappa * inserted
    q = x * x + z * z
    a, b, c = rodrigues_factors(q)
    small = q < SERIES_BELOW
    safe = np.where(small, 1.0, q)
    db = np.where(
        small, -1.0 / 24.0 + q * (1.0 / 360.0 - q / 13440.0), (a - 2.0 * b) / (2.0 * safe)
    )
    dc = np.where(
        small, -1.0 / 120.0 + q * (1.0 / 2520.0 - q / 120960.0), (b - 3.0 * c) / (2.0 * safe)
    )
    one, zero = np.ones_like(x), np.zeros_like(x)
    shift = np.stack([c * x * z, -b * x, one - c * x * x], axis=-1) * inserted[..., None]
    # Derivative by x, with dq/dx = 2 x
    slope = np.stack(
        [c * z + 2.0 * dc * x * x * z, -b - 2.0 * db * x * x, -2.0 * c * x - 2.0 * dc * x**3],
        axis=-1,
    )
    turning = np.stack([one - c * z * z, -b * z, c * x * z], axis=-1)
    return RelativeMotion(
        shift=shift,
        rotation=rotation_exp(np.stack([x, zero, z], axis=-1)),
        shift_slope=slope * (inserted**2)[..., None],
        rotation_slope=turning * inserted[..., None],
    )


def rodrigues_factors(squared: Array) -> tuple[Array, Array, Array]:
    """Return Rodrigues' factors sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2."""
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
