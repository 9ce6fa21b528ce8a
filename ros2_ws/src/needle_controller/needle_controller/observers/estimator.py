"""Interface of estimators: one needle, in the frame `target_plane`, in SI units."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import REDUCED, angles_from_rotation, rotation_from_angles


class Hypotheses(NamedTuple):
    """Estimate over several hypotheses, as the compiled laws read it.

    Attributes
    ----------
    mean : void
        Mean over all hypotheses, `filter.records.ESTIMATE`.
    torsions : ndarray, shape (K,)
        Mean over the hypotheses of each torsion, `filter.records.TORSION`.
    """

    mean: np.void
    torsions: npt.NDArray[np.void]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Estimated state of the needle after the last measurement.

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
        Warnings for the user; usually empty.
    miss : float, optional
        Probability that the tip is more than 1 mm from the plane x = 0; None if the estimator does
        not report it.
    hypotheses : Hypotheses, optional
        The underlying hypotheses; None from an estimator with a single state.
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
    """Return the estimate of a pose in the target plane.

    Parameters
    ----------
    position : array_like, shape (3,)
        The tip [m].
    rotation : array_like, shape (3, 3)
        Orientation: the heading is the last column, the needle bends to -y.
    curvature : float
        Curvature of the needle's path [1/m].
    covariance : array_like, shape (6, 6)
        Covariance of x, y, z [m], yaw, pitch, roll [rad].
    warnings : tuple of str
        Warnings for the user.
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
    """Estimates the tip's pose from measured tips and from the actual motion of the base."""

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
        """Advance by the actual motion since the last call, with evenly distributed rotation.

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
        """Correct by a measured tip.

        Parameters
        ----------
        tip : array_like, shape (3,)
            The tip [m]; NaN if it was not found.
        covariance : array_like, shape (3, 3), optional
            Its covariance [m^2]; by default the assumption of the estimator.
        age : float
            Length inserted since the exposure [m]; 0 if `advance` stopped there.
        """

    def estimate(self) -> Estimate:
        """Return the present estimate."""

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Transform everything into another target plane.

        Parameters
        ----------
        T_new_old : array_like, shape (4, 4)
            Pose of the old target plane in the new one.
        """
