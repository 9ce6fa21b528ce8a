"""The change of state and input that makes the reduced needle a triple integrator ([KC09] (6)-(8)).

Paper symbols: r = (x, pitch, roll) is the reduced state, s = (x, sin(pitch), kappa cos(pitch)
sin(roll)) the linearized state, v the virtual input ds3/dl, u the rotation rate. Leading axes
broadcast.

s only represents |roll| < pi/2: a roll beyond +-90 deg has the s of its mirror image. The inverse
of (7) divides by kappa cos(pitch) cos(roll), which is 0 there; `luenberger.saturate` keeps
estimates away from that boundary. The law and the observer hold u over a step and use (7)
integrated over it (`law`, `luenberger`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array

A: Array = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
B: Array = np.array([[0.0], [0.0], [1.0]])
C: Array = np.array([[1.0, 0.0, 0.0]])
"""The linearized system (8): ds/dl = A s + B v, measured w = C s."""

_POWERS: Array = np.stack([np.eye(3), A, 0.5 * (A @ A)])
_EXPONENTS: Array = np.add.outer(np.arange(3), np.arange(3)) + 1.0


def linearized_from_reduced(reduced: npt.ArrayLike, curvature: npt.ArrayLike) -> Array:
    """Return the linearized state s of the reduced state r: (6).

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad].
    curvature : array_like, shape (...)
        Curvature of the needle's path, kappa [1/m].

    Returns
    -------
    ndarray, shape (..., 3)
        s1 = x [m], s2 = ds1/dl [-], s3 = ds2/dl [1/m].
    """
    reduced = np.asarray(reduced, dtype=float)
    x, pitch, roll = reduced[..., 0], reduced[..., 1], reduced[..., 2]
    s3 = np.asarray(curvature, dtype=float) * np.cos(pitch) * np.sin(roll)
    return np.stack(np.broadcast_arrays(x, np.sin(pitch), s3), axis=-1)


def reduced_from_linearized(linearized: npt.ArrayLike, curvature: npt.ArrayLike) -> Array:
    """Return the reduced state r of s, with |roll| <= pi/2: the inverse of (6).

    Parameters
    ----------
    linearized : array_like, shape (..., 3)
        s within s2^2 + (s3 / kappa)^2 < 1 (see `luenberger.saturate`).
    curvature : array_like, shape (...)
        Curvature of the needle's path, kappa [1/m].

    Returns
    -------
    ndarray, shape (..., 3)
        x [m], pitch, roll [rad]; NaN if s lies outside the region.
    """
    linearized = np.asarray(linearized, dtype=float)
    x, s2 = linearized[..., 0], linearized[..., 1]
    sine = linearized[..., 2] / np.asarray(curvature, dtype=float)
    with np.errstate(invalid="ignore"):
        # atan2 instead of asin of a quotient is accurate near roll +-90 deg, too.
        pitch = np.arcsin(s2)
        roll = np.arctan2(sine, np.sqrt(1.0 - s2 * s2 - sine * sine))
    return np.stack(np.broadcast_arrays(x, pitch, roll), axis=-1)


def virtual_input(
    reduced: npt.ArrayLike, rotation_rate: npt.ArrayLike, curvature: npt.ArrayLike
) -> Array:
    """Return the virtual input v = ds3/dl of a rotation rate u: (7).

    Parameters
    ----------
    reduced : array_like, shape (..., 3)
        x [m], pitch, roll [rad].
    rotation_rate : array_like, shape (...)
        Rotation of the base per inserted length, u [rad/m].
    curvature : array_like, shape (...)
        Curvature of the needle's path, kappa [1/m].

    Returns
    -------
    ndarray, shape (...)
        v [1/m^2].
    """
    reduced = np.asarray(reduced, dtype=float)
    curvature = np.asarray(curvature, dtype=float)
    pitch, roll = reduced[..., 1], reduced[..., 2]
    turning = np.cos(pitch) * np.cos(roll) * np.asarray(rotation_rate, dtype=float)
    return np.asarray(curvature * (turning - curvature * np.sin(pitch)))


def transition(length: npt.ArrayLike) -> Array:
    """Return F = exp(A l), the exact undriven motion of (8) over an inserted length.

    Parameters
    ----------
    length : array_like, shape (...)
        Inserted length l [m].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        F, a polynomial in l, since A is nilpotent.
    """
    length = np.asarray(length, dtype=float)[..., None, None]
    return np.asarray(np.eye(3) + A * length + (A @ A) * (0.5 * length**2))


def process_covariance(density: Array, length: npt.ArrayLike) -> Array:
    """Return the exact covariance that process noise adds to s over an inserted length.

    Parameters
    ----------
    density : ndarray, shape (3, 3)
        Covariance of white noise on ds/dl per metre.
    length : array_like, shape (...)
        Inserted length l [m].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        The integral of F density F^T over 0..l.
    """
    length = np.asarray(length, dtype=float)[..., None, None]
    # exp(A l) = I + A l + A^2 l^2 / 2: the integral is a finite double sum of these two factors.
    products = np.einsum("iab,bc,jdc->ijad", _POWERS, density, _POWERS)
    lengths = length**_EXPONENTS / _EXPONENTS
    return np.asarray(np.einsum("...ij,ijad->...ad", lengths, products))


def reduced_covariance(covariance: Array, reduced: Array, curvature: npt.ArrayLike) -> Array:
    """Return the covariance of r from that of s, by the inverse of (6)'s Jacobian.

    Parameters
    ----------
    covariance : ndarray, shape (..., 3, 3)
        Covariance of s.
    reduced : ndarray, shape (..., 3)
        x [m], pitch, roll [rad]; the roll must not be +-90 deg.
    curvature : array_like, shape (...)
        kappa [1/m].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Covariance of x [m], pitch and roll [rad].
    """
    pitch, roll = reduced[..., 1], reduced[..., 2]
    jacobian = np.zeros((*pitch.shape, 3, 3))
    jacobian[..., 0, 0] = 1.0
    jacobian[..., 1, 1] = 1.0 / np.cos(pitch)
    jacobian[..., 2, 1] = np.tan(pitch) * np.tan(roll) / np.cos(pitch)
    steering = np.cos(pitch) * np.cos(roll)
    jacobian[..., 2, 2] = 1.0 / (np.asarray(curvature, dtype=float) * steering)
    return np.asarray(jacobian @ covariance @ np.swapaxes(jacobian, -1, -2))
