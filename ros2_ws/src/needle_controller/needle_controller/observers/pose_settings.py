"""What the estimators of the full pose assume of noise and of the entry."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_common.errors import OutOfBoundsError, UserError
from needle_controller.model.arc_motion import cross_matrix
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angle_axes, angles_from_rotation


@dataclasses.dataclass(frozen=True)
class PoseSettings:
    """Assumptions that the full-pose estimators share.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    curvature_spread : float
        Its standard deviation at the start, as a share of it; 0 takes it as known.
    curvature_range : tuple of float
        Least and most that is believed, as shares of it.
    measurement_std : float
        Standard deviation of one measured coordinate [m], where a tip comes without covariance.
    initial_angle_std : float
        How well pitch and yaw at the entry are known [rad].
    initial_roll_std : float
        How well the roll at the entry is known [rad].
    gate : float
        A tip is refused whose squared Mahalanobis distance (3 degrees of freedom) is above this.

    Raises
    ------
    UserError
        A value out of bounds.
    """

    curvature: float = 1.0 / 0.122
    curvature_spread: float = 0.15
    curvature_range: tuple[float, float] = (0.5, 1.6)
    measurement_std: float = 0.001 / math.sqrt(3.0)
    initial_angle_std: float = math.radians(10.0)
    initial_roll_std: float = math.radians(30.0)
    gate: float = 30.0

    def __post_init__(self) -> None:
        """Check every field."""
        tiny = float(np.nextafter(0.0, 1.0))
        for name, least, most, unit in (
            ("curvature", tiny, math.inf, "1/m"),
            ("curvature_spread", 0.0, 1.0, "-"),
            ("measurement_std", tiny, math.inf, "m"),
            ("initial_angle_std", tiny, math.pi, "rad"),
            ("initial_roll_std", tiny, 10.0 * math.pi, "rad"),
            ("gate", tiny, math.inf, "-"),
        ):
            value = float(getattr(self, name))
            if not least <= value <= most:
                raise OutOfBoundsError(name, value, least, most, unit)
            if math.isinf(value) and name != "gate":
                raise UserError(f"{name} = {value:g} {unit} is not finite")
        least, most = self.curvature_range
        if not 0.0 < least <= 1.0 <= most < math.inf:
            raise UserError(
                f"curvature_range = ({least:g}, {most:g}), wants 0 < least <= 1 <= most"
            )


def coordinate_covariance(
    position_covariance: Array, cross_covariance: Array, body_covariance: Array, rotation: Array
) -> Array:
    """Return the covariance of q from that of position and body rotation.

    Parameters
    ----------
    position_covariance : ndarray, shape (..., 3, 3)
        Of the position in `target_plane` [m^2].
    cross_covariance : ndarray, shape (..., 3, 3)
        Of position (rows) and body rotation vector (columns) [m rad].
    body_covariance : ndarray, shape (..., 3, 3)
        Of the rotation vector that leads from the estimate to the truth, in the tip's own axes.
    rotation : ndarray, shape (..., 3, 3)
        The tip's orientation.

    Returns
    -------
    ndarray, shape (..., 6, 6)
        In the order of `Estimate.coordinates`; off pitch +-90 deg.
    """
    # d(angles) = axes^-1 R (body rotation vector).
    angles = angles_from_rotation(rotation)
    to_angles = np.linalg.solve(angle_axes(angles), rotation)
    transposed = np.swapaxes(to_angles, -1, -2)
    covariance = np.empty((*rotation.shape[:-2], 6, 6))
    covariance[..., :3, :3] = position_covariance
    covariance[..., :3, 3:] = cross_covariance @ transposed
    covariance[..., 3:, :3] = np.swapaxes(covariance[..., :3, 3:], -1, -2)
    covariance[..., 3:, 3:] = to_angles @ body_covariance @ transposed
    return covariance


def start_rotation_precision(settings: PoseSettings) -> Array:
    """Return the inverse variances of the start's body rotation vector, shape (3,) [1/rad^2]."""
    angle, roll = settings.initial_angle_std**-2.0, settings.initial_roll_std**-2.0
    return np.array([angle, angle, roll])


def turned_cross(rotation: Array, vector: Array) -> Array:
    """Return -R v^: how a position p + R v changes with the body rotation vector."""
    return np.asarray(-(rotation @ cross_matrix(vector)))
