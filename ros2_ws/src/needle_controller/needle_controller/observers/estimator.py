"""Interface of every estimator: of one needle, in the frame `target_plane`, SI."""

from __future__ import annotations

import dataclasses
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
class Hypotheses:
    """The part of an estimate over several hypotheses that a law needs.

    Attributes
    ----------
    torsions : ndarray, shape (K,)
        The mean over each torsion, `filter.records.TORSION`.
    base : float
        Rotation of the base since the start [rad]; the torsions' angles count from there too.
    wound : float
        Rotation of the base as the joint says it [rad].
    uncertainty : ndarray, shape (3,)
        Variance of x [m^2], its covariance with sin(pitch) [m], variance of sin(pitch).
    """

    torsions: npt.NDArray[np.void]
    base: float
    wound: float
    uncertainty: Array


@dataclasses.dataclass(frozen=True)
class Estimate:
    """State of the needle as known after the last measurement.

    Attributes
    ----------
    coordinates : ndarray, shape (6,)
        x, y, z [m], yaw, pitch, roll [rad]: the pose of the tip.
    linearized : ndarray, shape (3,)
        The linearized state s of (6).
    curvature : float
        Curvature of the needle's path, assumed or estimated [1/m].
    covariance : ndarray, shape (6, 6)
        Covariance of `coordinates`, in their order.
    warnings : tuple of str
        What a user should know of this estimate; empty as a rule.
    miss : float, optional
        Probability that the tip is more than 1 mm from the plane x = 0; None from an estimator that
        does not judge itself.
    hypotheses : Hypotheses, optional
        Of what it is the mean; None from an estimator that knows one state only.
    """

    coordinates: Array
    linearized: Array
    curvature: float
    covariance: Array
    warnings: tuple[str, ...] = ()
    miss: float | None = None
    hypotheses: Hypotheses | None = None

    @property
    def reduced(self) -> Array:
        """The reduced state r = (x, pitch, roll), shape (3,)."""
        return self.coordinates[list(REDUCED)]

    @property
    def position(self) -> Array:
        """The tip, shape (3,) [m]."""
        return self.coordinates[:3]

    @property
    def rotation(self) -> Array:
        """The tip's orientation, shape (3, 3)."""
        return rotation_from_angles(self.coordinates[3:])


def pose_estimate(
    position: npt.ArrayLike,
    rotation: npt.ArrayLike,
    curvature: float,
    covariance: npt.ArrayLike,
    warnings: tuple[str, ...] = (),
) -> Estimate:
    """Return the estimate that a pose in the target plane is.

    Parameters
    ----------
    position : array_like, shape (3,)
        The tip [m].
    rotation : array_like, shape (3, 3)
        Its orientation: the heading is the last column, the needle bends to -y.
    curvature : float
        Of the needle's path [1/m].
    covariance : array_like, shape (6, 6)
        Of x, y, z [m], yaw, pitch, roll [rad].
    warnings : tuple of str
        What a user should know of it.
    """
    coordinates = np.concatenate(
        [np.asarray(position, dtype=float), angles_from_rotation(rotation)]
    )
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[list(REDUCED)], curvature),
        curvature=float(curvature),
        covariance=np.array(covariance, dtype=float),
        warnings=warnings,
    )


class Estimator(Protocol):
    """Estimates the tip's pose from where it was seen and from what the base really did."""

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start over at a first measurement.

        Parameters
        ----------
        tip : array_like, shape (3,)
            The tip [m].
        joints : array_like, shape (2,)
            Insertion [m] and rotation [rad] of the base at the same instant.
        """

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Move on by what really happened since the last call, the rotation spread evenly over it.

        Parameters
        ----------
        d_insertion : float
            Inserted length, >= 0 [m].
        d_rotation : float
            Rotation of the base [rad].

        Raises
        ------
        ValueError
            A negative or non-finite insertion: the model holds for forward insertion only.
        """

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Take a measurement of the tip.

        Parameters
        ----------
        tip : array_like, shape (3,)
            The tip [m]; NaN where it was not found.
        covariance : array_like, shape (3, 3), optional
            Its covariance [m^2]; the estimator's own assumption if none is given.
        age : float
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
