"""Interface of every estimator, the same for one needle and for 10,000.

Everything is in the frame `target_plane`, SI. Leading axes are needles: the node's single needle
has shape (3,), a study's 10,000 needles (10000, 3).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import (
    REDUCED,
    angles_from_rotation,
    rotation_from_angles,
)


@dataclasses.dataclass(frozen=True)
class Estimate:
    """State of the needle as known after the last measurement.

    Attributes
    ----------
    coordinates : ndarray, shape (..., 6)
        x, y, z [m], yaw, pitch, roll [rad]: the pose of the tip.
    linearized : ndarray, shape (..., 3)
        The linearized state s of (6).
    curvature : ndarray, shape (...)
        Curvature of the needle's path, assumed or estimated [1/m].
    warnings : tuple of str
        What a user should know of this estimate; empty as a rule.
    covariance_of : callable
        Returns `covariance`; studies of many needles do not pay for what they do not read.
    doubtful : ndarray of bool, shape (...), optional
        Whether the estimate cannot be relied on; None from an estimator that never says so.
    doubts : tuple of str
        Why not; of any of the needles.
    """

    coordinates: Array
    linearized: Array
    curvature: Array
    warnings: tuple[str, ...]
    covariance_of: Callable[[], Array] = dataclasses.field(repr=False)
    doubtful: npt.NDArray[np.bool_] | None = dataclasses.field(default=None, kw_only=True)
    doubts: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)

    @property
    def reduced(self) -> Array:
        """The reduced state r = (x, pitch, roll), shape (..., 3)."""
        return self.coordinates[..., REDUCED]

    @property
    def position(self) -> Array:
        """The tip, shape (..., 3) [m]."""
        return self.coordinates[..., :3]

    @property
    def rotation(self) -> Array:
        """The tip's orientation, shape (..., 3, 3)."""
        return rotation_from_angles(self.coordinates[..., 3:])

    @property
    def covariance(self) -> Array:
        """Covariance of `coordinates`, in their order, shape (..., 6, 6)."""
        return self.covariance_of()


def pose_estimate(
    position: npt.ArrayLike,
    rotation: npt.ArrayLike,
    curvature: npt.ArrayLike,
    covariance: npt.ArrayLike,
    warnings: tuple[str, ...] = (),
) -> Estimate:
    """Return the estimate that a pose in the target plane is.

    Parameters
    ----------
    position : array_like, shape (..., 3)
        The tip [m].
    rotation : array_like, shape (..., 3, 3)
        Its orientation: the heading is the last column, the needle bends to -y.
    curvature : array_like, shape (...)
        Of the needle's path [1/m].
    covariance : array_like, shape (..., 6, 6)
        Of x, y, z [m], yaw, pitch, roll [rad].
    warnings : tuple of str
        What a user should know of it.
    """
    places = np.asarray(position, dtype=float)
    coordinates = np.concatenate([places, angles_from_rotation(rotation)], axis=-1)
    shape = coordinates.shape[:-1]
    kappa = np.array(np.broadcast_to(np.asarray(curvature, dtype=float), shape))
    known = np.array(np.broadcast_to(np.asarray(covariance, dtype=float), (*shape, 6, 6)))
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[..., REDUCED], kappa),
        curvature=kappa,
        warnings=warnings,
        covariance_of=lambda: known,
    )


class Estimator(Protocol):
    """Estimates the tip's pose from where it was seen and from what the base really did."""

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement.

        Parameters
        ----------
        tip : array_like, shape (..., 3)
            The tip [m].
        joints : array_like, shape (..., 2)
            Insertion [m] and rotation [rad] of the base at the same instant.
        """

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened since the last call, the rotation spread evenly over it.

        Parameters
        ----------
        d_insertion : array_like, shape (...)
            Inserted length, >= 0 [m].
        d_rotation : array_like, shape (...)
            Rotation of the base [rad].

        Raises
        ------
        ValueError
            A negative or non-finite insertion: the model holds for forward insertion only.
        """

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement of the tip.

        Parameters
        ----------
        tip : array_like, shape (..., 3)
            The tip [m]; NaN for a needle whose tip was not found.
        covariance : array_like, shape (..., 3, 3), optional
            Its covariance [m^2]; the estimator's own assumption if none is given.
        age : array_like, shape (...)
            Length inserted since the exposure [m]; 0 when `advance` stopped at it.
        """

    def estimate(self) -> Estimate:
        """Return what is known now."""

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane.

        Parameters
        ----------
        T_new_old : array_like, shape (4, 4)
            The old target plane's pose in the new one.
        """
