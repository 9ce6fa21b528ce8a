"""Rigid transforms as 4 x 4 matrices and the exponential of a body twist, over leading axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

# Below this angle (theta - sin theta) / theta^3 loses digits; its series to theta^8 does not.
_SERIES_BELOW = 0.3


def exp_twist(twist: ArrayLike) -> FloatArray:
    """Return the rigid motion exp(twist^) in closed form.

    Parameters
    ----------
    twist : array_like, shape (..., 6)
        Body twist times its duration [v (m), omega (rad)], as in [KC09] eq. (2).

    Returns
    -------
    ndarray, shape (..., 4, 4)
        T_start_end of a frame that moves with this twist.

    Raises
    ------
    ValueError
        If the last axis is not 6 long.
    """
    twist = np.asarray(twist, dtype=np.float64)
    if twist.ndim == 0 or twist.shape[-1] != 6:
        raise ValueError(f"a twist has shape (..., 6), got {twist.shape}")
    angle = np.linalg.norm(twist[..., 3:], axis=-1)[..., np.newaxis, np.newaxis]
    hat = np.zeros((*twist.shape[:-1], 3, 3))
    hat[..., 2, 1], hat[..., 0, 2], hat[..., 1, 0] = np.moveaxis(twist[..., 3:], -1, 0)
    hat -= np.swapaxes(hat, -1, -2)
    hat_squared = hat @ hat

    first = np.sinc(angle / np.pi)  # sin(a) / a
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2  # (1 - cos(a)) / a^2
    third = _third_coefficient(angle)  # (a - sin(a)) / a^3
    identity = np.eye(3)
    result = np.zeros((*twist.shape[:-1], 4, 4))
    result[..., :3, :3] = identity + first * hat + second * hat_squared
    left_jacobian = identity + second * hat + third * hat_squared
    result[..., :3, 3] = (left_jacobian @ twist[..., :3, np.newaxis])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def rotation_about_z(angle: ArrayLike) -> FloatArray:
    """Return Rz(angle) as a transform, shape (..., 4, 4), for `angle` (rad) of shape (...)."""
    return _rotation(angle, 0, 1)


def rotation_about_y(angle: ArrayLike) -> FloatArray:
    """Return Ry(angle) as a transform, shape (..., 4, 4), for `angle` (rad) of shape (...)."""
    return _rotation(angle, 2, 0)


def _rotation(angle: ArrayLike, first: int, second: int) -> FloatArray:
    """Return the transform that rotates one axis towards another."""
    angle = np.asarray(angle, dtype=np.float64)
    result = np.zeros((*angle.shape, 4, 4))
    result[..., range(4), range(4)] = 1.0
    result[..., first, first] = result[..., second, second] = np.cos(angle)
    result[..., second, first] = np.sin(angle)
    result[..., first, second] = -result[..., second, first]
    return result


def _third_coefficient(angle: FloatArray) -> FloatArray:
    """Return (a - sin a) / a^3, by its series where the difference would cancel."""
    square = angle**2
    series = (
        1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0 * (1.0 - square / 110.0)))
    ) / 6.0
    safe = np.where(angle < _SERIES_BELOW, 1.0, angle)
    return np.where(angle < _SERIES_BELOW, series, (safe - np.sin(safe)) / safe**3)
