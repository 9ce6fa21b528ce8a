"""The paper's observer ([KC09] (9)): a steady gain on the tip's distance from the plane."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import (
    linearized_from_reduced,
    process_covariance,
    reduced_covariance,
    reduced_from_linearized,
    transition,
)
from needle_controller.model.gains import sampled_observer_gain
from needle_controller.model.kinematics import YAW, angles_from_rotation, rotation_from_angles
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.luenberger_steps import advance_states, correct_states
from needle_controller.observers.saturation import saturate


@dataclasses.dataclass(frozen=True)
class LuenbergerSettings:
    """Assumptions of the observer.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    observer_poles : ndarray of complex, shape (3,)
        Eigenvalues of A - L C [1/m], from `gains.design_gains`.
    process_noise : ndarray, shape (3, 3)
        Covariance of white noise on ds/dl per metre; enters the covariance only.
    measurement_std : float
        Standard deviation of one measured coordinate [m]; enters the covariance only.
    saturation_margin : float
        Distance of the estimate from the border of (6)'s region, in [0, 1).
    initial_yaw_std, initial_pitch_std, initial_roll_std : float
        How well the orientation at the entry is known [rad]; enters the covariance only.
    """

    curvature: float
    observer_poles: npt.NDArray[np.complex128]
    process_noise: Array
    measurement_std: float
    saturation_margin: float
    initial_yaw_std: float
    initial_pitch_std: float
    initial_roll_std: float


class LuenbergerObserver:
    """Observer (9), sampled for the insertion that really happened, saturated as in [KC09] IV-A.

    It starts at (first measurement, 0, 0) where the needle enters along the plane with roll 0, and
    in general at the orientation the base gives it. x is estimated; y and z are the last measured
    tip; the yaw is integrated from its start by (4) and is not observed.

    Parameters
    ----------
    settings : LuenbergerSettings
        Gains and assumptions.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: LuenbergerSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self._settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self._s: Array = np.zeros(3)
        self._yaw: Array = np.zeros(())
        self._tip: Array = np.zeros(3)
        self._tip_covariance: Array = np.zeros((3, 3))
        self._since_correction: Array = np.zeros(())
        self._inserted: Array = np.zeros(())
        self._covariance: Array = np.zeros((3, 3))
        self._saturated: npt.NDArray[np.bool_] = np.zeros((), dtype=bool)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        settings = self._settings
        tip, joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        turned = np.zeros((*joints.shape[:-1], 3))
        turned[..., 2] = joints[..., 1]
        angles = angles_from_rotation(self.initial_rotation @ rotation_from_angles(turned))
        shape = np.broadcast_shapes(tip.shape[:-1], angles.shape[:-1])
        self._tip = np.broadcast_to(tip, (*shape, 3)).copy()
        self._yaw = np.broadcast_to(angles[..., 0], shape).copy()
        self._tip_covariance = np.eye(3) * settings.measurement_std**2
        self._since_correction = np.zeros(())
        self._inserted = np.zeros(())
        reduced = np.stack(
            np.broadcast_arrays(tip[..., 0], angles[..., 1], angles[..., 2]), axis=-1
        )
        stds = (
            settings.measurement_std,
            settings.initial_pitch_std,
            settings.curvature * settings.initial_roll_std,
        )
        self._covariance = np.diag(np.square(stds))
        self._take(linearized_from_reduced(reduced, settings.curvature))

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        length, turn = np.asarray(d_insertion, dtype=float), np.asarray(d_rotation, dtype=float)
        if not (np.all(np.isfinite(length)) and np.all(length >= 0.0)):
            raise ValueError(f"d_insertion = {length} m, wants finite and >= 0")
        settings = self._settings
        shape = np.broadcast_shapes(self._s.shape[:-1], length.shape, turn.shape)
        states, saturated = _rows(self._s, shape), np.empty(math.prod(shape), dtype=bool)
        yaw = np.broadcast_to(self._yaw, shape).flatten()
        motion = np.broadcast_to(length, shape).flatten(), np.broadcast_to(turn, shape).flatten()
        region = settings.curvature, settings.saturation_margin
        advance_states(states, yaw, saturated, motion, region)
        self._s, self._yaw = states.reshape(*shape, 3), yaw.reshape(shape)
        self._saturated = saturated.reshape(shape)
        self._since_correction = self._since_correction + length
        self._inserted = self._inserted + length
        f = transition(length)
        self._covariance = f @ self._covariance @ np.swapaxes(f, -1, -2) + process_covariance(
            self._settings.process_noise, length
        )

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`.

        The gain is steady: it does not use `covariance`, which only passes into the estimate's. The
        tip `age` ago is taken as x - age s2 + age^2 / 2 s3.
        """
        tip, age = np.asarray(tip, dtype=float), np.asarray(age, dtype=float)
        settings = self._settings
        found = np.isfinite(tip[..., 0]) & np.isfinite(tip[..., 1]) & np.isfinite(tip[..., 2])
        noise = np.asarray(settings.measurement_std**2)
        if covariance is not None:
            covariance = np.asarray(covariance, dtype=float)
            found = found & np.isfinite(covariance[..., 0, 0])
            noise = np.where(np.isfinite(covariance[..., 0, 0]), covariance[..., 0, 0], noise)
        row = transition(-age)[..., 0, :]
        all_used = bool(np.all(found))
        gain = sampled_observer_gain(settings.observer_poles, self._since_correction)
        shape = np.broadcast_shapes(self._s.shape[:-1], found.shape, age.shape, gain.shape[:-1])
        states, saturated = _rows(self._s, shape), np.empty(math.prod(shape), dtype=bool)
        x = tip[..., 0] if all_used else np.where(found, tip[..., 0], np.nan)
        measured = np.broadcast_to(x, shape).flatten(), np.broadcast_to(age, shape).flatten()
        gains = gain.reshape(1, 3) if gain.ndim == 1 else _rows(gain, shape)
        region = settings.curvature, settings.saturation_margin
        correct_states(states, saturated, measured, gains, region)
        self._s, self._saturated = states.reshape(*shape, 3), saturated.reshape(shape)
        self._tip = tip.copy() if all_used else np.where(found[..., None], tip, self._tip)
        if covariance is not None:
            self._tip_covariance = np.where(
                found[..., None, None], covariance, self._tip_covariance
            )
        # Only what was used narrows the covariance; one shape for all needles while all were.
        taken = gain if all_used else gain * found[..., None]
        keep = np.eye(3) - taken[..., :, None] * row[..., None, :]
        self._covariance = (
            keep @ self._covariance @ np.swapaxes(keep, -1, -2)
            + taken[..., :, None] * taken[..., None, :] * noise[..., None, None]
        )
        self._since_correction = (
            np.zeros(()) if all_used else np.where(found, 0.0, self._since_correction)
        )

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        curvature = self._settings.curvature
        reduced = reduced_from_linearized(self._s, curvature)
        x, pitch, roll = (reduced[..., i] for i in range(3))
        parts = (x, self._tip[..., 1], self._tip[..., 2], self._yaw, pitch, roll)
        coordinates = np.stack(np.broadcast_arrays(*parts), axis=-1)
        warnings: tuple[str, ...] = ()
        if np.any(self._saturated):
            warnings = (
                "the estimate was saturated: the roll it wants is beyond what its coordinates say",
            )
        return Estimate(
            coordinates=coordinates,
            linearized=self._s.copy(),
            curvature=np.full(coordinates.shape[:-1], curvature),
            warnings=warnings,
            covariance_of=lambda: self._coordinate_covariance(reduced),
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn, shift = transform[:3, :3], transform[:3, 3]
        coordinates = self.estimate().coordinates
        angles = angles_from_rotation(turn @ rotation_from_angles(coordinates[..., 3:]))
        position = coordinates[..., :3] @ turn.T + shift
        self._tip = self._tip @ turn.T + shift
        self._tip_covariance = turn @ self._tip_covariance @ turn.T
        self._yaw = angles[..., 0]
        self.initial_rotation = turn @ self.initial_rotation
        reduced = np.stack([position[..., 0], angles[..., 1], angles[..., 2]], axis=-1)
        self._take(linearized_from_reduced(reduced, self._settings.curvature))

    def _take(self, linearized: Array) -> None:
        self._s, self._saturated = saturate(
            linearized, self._settings.curvature, self._settings.saturation_margin
        )

    def _coordinate_covariance(self, reduced: Array) -> Array:
        """Return the covariance of q, linear in the estimate's error."""
        curvature = self._settings.curvature
        of_reduced = reduced_covariance(self._covariance, reduced, curvature)
        covariance = np.zeros((*reduced.shape[:-1], 6, 6))
        index = np.array([0, 4, 5])
        covariance[..., index[:, None], index[None, :]] = of_reduced
        covariance[..., 1:3, 1:3] = self._tip_covariance[..., 1:3, 1:3]
        # Not observed: what was unknown at the start, and all the turning that wrong rolls can have
        # hidden.
        covariance[..., YAW, YAW] = (
            self._settings.initial_yaw_std**2 + (curvature * self._inserted) ** 2
        )
        return covariance


def _rows(vectors: Array, shape: tuple[int, ...]) -> Array:
    """Return a copy of vectors, one row for each of `shape`, (N, 3)."""
    return np.array(np.broadcast_to(vectors, (*shape, 3)).reshape(-1, 3))
