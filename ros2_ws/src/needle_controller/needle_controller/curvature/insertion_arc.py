"""Arc of a pure insertion ([KC09] IV-B): points, and derivatives with respect to the unknowns.

The unknowns, (..., 7): the entry [m], two angles of the heading there [rad], and the two components
of kappa n across the heading [1/m], where n is the direction in which the needle bends. There is no
singularity at kappa = 0. Leading axes broadcast.
"""

from __future__ import annotations

import numpy as np

from needle_controller.model.arc_motion import (
    SERIES_BELOW,
    cross_matrix,
    left_jacobian,
    rodrigues_factors,
    rotation_exp,
)
from needle_controller.model.arrays import Array

ENTRY, HEADING, BEND = slice(0, 3), slice(3, 5), slice(5, 7)
UNKNOWNS = 7


def frame(heading: Array) -> Array:
    """Return axes as columns; the third is the heading."""
    aside = np.eye(3)[np.argmin(np.abs(heading))]
    first = np.cross(aside, heading)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(heading, first), heading], axis=-1)


def headings(angles: Array) -> Array:
    """Return the frames whose third axis is rotated by two angles, shape (..., 3, 3)."""
    return rotation_exp(_with_zero(angles))


def _with_zero(angles: Array) -> Array:
    return np.concatenate([angles, np.zeros_like(angles[..., :1])], axis=-1)


def arc_points(unknowns: Array, length: Array) -> tuple[Array, Array, Array]:
    """Return points on the arcs, (..., K, 3), derivatives, (..., K, 3, 7), and tangents."""
    bend = unknowns[..., None, BEND]
    rotation = headings(unknowns[..., HEADING])[..., None, :, :]
    q = np.sum(bend**2, axis=-1) * length**2
    along, across, d_along, d_across = _arc_factors(q)
    local = np.concatenate(
        [bend * (across * length**2)[..., None], (along * length)[..., None]], axis=-1
    )
    turned = np.einsum("...ij,...j->...i", rotation, local)
    slopes = np.zeros((*turned.shape, UNKNOWNS))
    slopes[..., ENTRY] = np.eye(3)
    turning = left_jacobian(_with_zero(unknowns[..., HEADING]))[..., None, :, :2]
    slopes[..., HEADING] = -cross_matrix(turned) @ turning
    for i in range(2):
        dq = 2.0 * bend[..., i] * length**2
        d_local = bend * (d_across * dq * length**2)[..., None]
        d_local[..., i] += across * length**2
        whole = np.concatenate([d_local, (d_along * dq * length)[..., None]], axis=-1)
        slopes[..., 5 + i] = np.einsum("...ij,...j->...i", rotation, whole)
    sides = bend * (along * length)[..., None]
    ahead = 1.0 - (across * q)[..., None]
    tangent = np.einsum("...ij,...j->...i", rotation, np.concatenate([sides, ahead], axis=-1))
    return unknowns[..., None, ENTRY] + turned, slopes, tangent


def _arc_factors(q: Array) -> tuple[Array, Array, Array, Array]:
    """Return sin(a)/a and (1 - cos(a))/a^2 for q = a^2, and their derivatives with respect to q."""
    along, across, _ = rodrigues_factors(q)
    small = q < SERIES_BELOW
    safe = np.where(small, 1.0, q)
    cosine = np.cos(np.sqrt(safe))
    d_along = np.where(
        small, -1.0 / 6.0 + q / 60.0 - q * q / 1680.0, (cosine - along) / (2.0 * safe)
    )
    d_across = np.where(
        small, -1.0 / 24.0 + q / 360.0 - q * q / 13440.0, (along - 2.0 * across) / (2.0 * safe)
    )
    return along, across, d_along, d_across
