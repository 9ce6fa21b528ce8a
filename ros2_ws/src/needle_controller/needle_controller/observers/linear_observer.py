"""The paper's observer on (8), with a gain from its covariance, on both sides of roll +-90 deg.

With `observer_poles` it is observer (9) with the paper's steady gain, as `luenberger` has it, and
knows flips of the bevel; without, its gain is the time-varying Kalman gain of the same linear
system. Each has an innovation gate.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_common.errors import OutOfBoundsError
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import (
    linearized_from_reduced,
    process_covariance,
    reduced_covariance,
    transition,
)
from needle_controller.model.gains import checked_weights, sampled_observer_gain
from needle_controller.model.kinematics import YAW, angles_from_rotation, rotation_from_angles
from needle_controller.observers.bend_side import bend_sign_of, reduced_on_side, wrapped
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.innovation_gate import InnovationGate
from needle_controller.observers.saturation import saturate


@dataclasses.dataclass(frozen=True)
class LinearObserverSettings:
    """What the observer assumes.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    process_noise : array_like, shape (3, 3)
        Covariance of white noise on ds/dl per metre.
    measurement_std : float
        Standard deviation of one measured coordinate [m], where a tip comes without covariance.
    initial_pitch_std, initial_roll_std, initial_yaw_std : float
        How well the orientation at the entry is known [rad].
    observer_poles : ndarray of complex, shape (3,), optional
        Eigenvalues of A - L C [1/m], from `gains.design_gains`: the steady gain of (9). The
        time-varying Kalman gain if none are given.
    saturation_margin : float
        Distance of the estimate from the border of (6)'s region, in [0, 1).
    gate : float
        A tip is refused whose squared innovation is above this times its variance.

    Raises
    ------
    UserError
        A value out of bounds, or process noise that is no covariance.
    """

    curvature: float
    process_noise: npt.ArrayLike
    measurement_std: float
    initial_pitch_std: float
    initial_roll_std: float
    initial_yaw_std: float
    observer_poles: npt.NDArray[np.complex128] | None = None
    saturation_margin: float = 0.11
    gate: float = 25.0

    def __post_init__(self) -> None:
        """Check every field."""
        for name, unit in (("curvature", "1/m"), ("measurement_std", "m")):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0.0):
                raise OutOfBoundsError(name, value, np.nextafter(0.0, 1.0), math.inf, unit)
        for name in ("initial_pitch_std", "initial_roll_std", "initial_yaw_std"):
            value = float(getattr(self, name))
            if not 0.0 <= value <= math.pi:
                raise OutOfBoundsError(name, value, 0.0, math.pi, "rad")
        if not 0.0 <= self.saturation_margin < 1.0:
            raise OutOfBoundsError("saturation_margin", self.saturation_margin, 0.0, 1.0, "-")
        object.__setattr__(
            self, "process_noise", checked_weights("process_noise", self.process_noise)
        )


class LinearObserver:
    """Estimates (x, pitch, roll) from x alone; see `estimator.Estimator`.

    It starts where the base says the needle enters. x is estimated; y and z are the last measured
    tip; the yaw is integrated by (4) and is not observed.

    Parameters
    ----------
    settings : LinearObserverSettings
        What is assumed.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: LinearObserverSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self.settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self._process_noise: Array = np.asarray(settings.process_noise, dtype=float)
        self._gate = InnovationGate(settings.gate)
        self.reset(np.zeros(3), np.zeros(2))

    @property
    def bend_sign(self) -> Array:
        """Sign of cos(roll) that the estimate has, shape (...)."""
        return np.asarray(self._sign)

    def flip_to(self, bend_sign: npt.ArrayLike) -> None:
        """Announce that the base takes the roll to a side, over the advances to come.

        Without it the estimated roll stops at +-90 deg, for what crosses there is noise as a rule.

        Parameters
        ----------
        bend_sign : array_like, shape (...)
            Wanted sign of cos(roll), +1 or -1; 0 keeps the present one.
        """
        wanted = np.asarray(bend_sign, dtype=float)
        self._wanted = np.where(wanted == 0.0, self._sign, np.copysign(1.0, wanted))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        settings = self.settings
        tip, joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        turned = np.zeros((*joints.shape[:-1], 3))
        turned[..., 2] = joints[..., 1]
        angles = angles_from_rotation(self.initial_rotation @ rotation_from_angles(turned))
        shape = np.broadcast_shapes(tip.shape[:-1], angles.shape[:-1])
        self._tip = np.broadcast_to(tip, (*shape, 3)).copy()
        self._tip_covariance = np.eye(3) * settings.measurement_std**2
        self._yaw = np.broadcast_to(angles[..., 0], shape).copy()
        self._inserted = np.zeros(())
        self._since_correction = np.zeros(())
        self._sign = np.broadcast_to(bend_sign_of(angles[..., 2]), shape).copy()
        self._wanted = self._sign
        self._gate.reset()
        parts = np.broadcast_arrays(tip[..., 0], angles[..., 1], angles[..., 2])
        stds = (
            settings.measurement_std,
            settings.initial_pitch_std,
            settings.curvature * settings.initial_roll_std,
        )
        self._covariance: Array = np.diag(np.square(stds))
        self._take(linearized_from_reduced(np.stack(parts, axis=-1), settings.curvature))

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        length, turn = np.asarray(d_insertion, dtype=float), np.asarray(d_rotation, dtype=float)
        if not (np.all(np.isfinite(length)) and np.all(length >= 0.0)):
            raise ValueError(f"d_insertion = {length} m, wants finite and >= 0")
        if not np.all(np.isfinite(turn)):
            raise ValueError(f"d_rotation = {turn} rad, wants finite")
        curvature, s = self.settings.curvature, self._s
        before = self._reduced()
        pitch, roll = before[..., 1], before[..., 2]
        # Measured from the middle of its side, +-90 deg are the borders on both sides.
        middle = np.where(self._sign < 0.0, np.pi, 0.0)
        turned = wrapped(roll - middle) + turn - curvature * np.cos(roll) * np.tan(pitch) * length
        stays = self._sign == self._wanted
        turned = middle + np.where(stays, np.clip(turned, -0.5 * np.pi, 0.5 * np.pi), turned)
        sign = np.where(stays, self._sign, bend_sign_of(turned))
        pitched = pitch + curvature * np.sin(roll) * length
        added = curvature * np.cos(pitched) * np.sin(turned) - s[..., 2]
        s1 = s[..., 0] + length * s[..., 1] + length**2 * (0.5 * s[..., 2] + added / 6.0)
        s2 = s[..., 1] + length * (s[..., 2] + 0.5 * added)
        f = transition(length)
        self._covariance = f @ self._covariance @ np.swapaxes(f, -1, -2) + process_covariance(
            self._process_noise, length
        )
        crossed = sign != self._sign
        if np.any(crossed):
            # The error of s3 changes its sign with the side.
            mirror = np.ones((*crossed.shape, 3))
            mirror[..., 2] = np.where(crossed, -1.0, 1.0)
            self._covariance = self._covariance * mirror[..., :, None] * mirror[..., None, :]
        self._sign = sign
        self._take(np.stack(np.broadcast_arrays(s1, s2, s[..., 2] + added), axis=-1))
        after = self._reduced()
        # (4), trapezoidal.
        slope = np.cos(roll) / np.cos(pitch) + np.cos(after[..., 2]) / np.cos(after[..., 1])
        self._yaw = self._yaw + 0.5 * length * curvature * slope
        self._inserted = self._inserted + length
        self._since_correction = self._since_correction + length

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`.

        The tip `age` ago is taken as x - age s2 + age^2 / 2 s3.
        """
        tip, age = np.asarray(tip, dtype=float), np.asarray(age, dtype=float)
        found = np.all(np.isfinite(tip), axis=-1)
        noise = np.asarray(self.settings.measurement_std**2)
        if covariance is not None:
            covariance = np.asarray(covariance, dtype=float)
            noise = covariance[..., 0, 0]
            found = found & np.isfinite(noise)
        row = transition(-age)[..., 0, :]
        crossed = np.squeeze(self._covariance @ row[..., None], axis=-1)
        spread = np.sum(row * crossed, axis=-1) + np.where(np.isfinite(noise), noise, 1.0)
        innovation = np.where(found, tip[..., 0] - np.sum(row * self._s, axis=-1), 0.0)
        used = self._gate.admit(innovation**2 / spread, found)
        poles = self.settings.observer_poles
        if poles is None:
            gain = crossed / spread[..., None]
        else:
            gain = sampled_observer_gain(poles, self._since_correction)
        all_used = bool(np.all(used))
        self._take(self._s + gain * np.where(used, innovation, 0.0)[..., None])
        # One covariance for all needles while all of them were seen.
        taken = gain if all_used else gain * used[..., None]
        keep = np.eye(3) - taken[..., :, None] * row[..., None, :]
        noise = np.where(np.isfinite(noise), noise, 0.0)
        self._covariance = (
            keep @ self._covariance @ np.swapaxes(keep, -1, -2)
            + taken[..., :, None] * taken[..., None, :] * noise[..., None, None]
        )
        self._tip = np.where(used[..., None], tip, self._tip)
        if covariance is not None:
            self._tip_covariance = np.where(used[..., None, None], covariance, self._tip_covariance)
        since = np.where(used, 0.0, self._since_correction)
        self._since_correction = np.zeros(()) if all_used else since

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        reduced = self._reduced()
        x, pitch, roll = (reduced[..., i] for i in range(3))
        parts = (x, self._tip[..., 1], self._tip[..., 2], self._yaw, pitch, roll)
        coordinates = np.stack(np.broadcast_arrays(*parts), axis=-1)
        warnings = self._gate.warnings()
        if np.any(self._saturated):
            warnings = (
                *warnings,
                "the estimate was saturated: the roll it wants is beyond what its coordinates say",
            )
        return Estimate(
            coordinates=coordinates,
            linearized=self._s.copy(),
            curvature=np.full(coordinates.shape[:-1], self.settings.curvature),
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
        self._sign = bend_sign_of(angles[..., 2])
        self._wanted = self._sign
        reduced = np.stack([position[..., 0], angles[..., 1], angles[..., 2]], axis=-1)
        self._take(linearized_from_reduced(reduced, self.settings.curvature))

    def _reduced(self) -> Array:
        return reduced_on_side(self._s, self.settings.curvature, self._sign)

    def _take(self, linearized: Array) -> None:
        self._s, self._saturated = saturate(
            linearized, self.settings.curvature, self.settings.saturation_margin
        )

    def _coordinate_covariance(self, reduced: Array) -> Array:
        """Return the covariance of q, linear in the estimate's error."""
        curvature = self.settings.curvature
        covariance = np.zeros((*reduced.shape[:-1], 6, 6))
        of_reduced = reduced_covariance(self._covariance, reduced, curvature)
        index = np.array([0, 4, 5])
        covariance[..., index[:, None], index[None, :]] = of_reduced
        covariance[..., 1:3, 1:3] = self._tip_covariance[..., 1:3, 1:3]
        # Not observed: what was unknown at the start, and all that wrong rolls can have hidden.
        covariance[..., YAW, YAW] = (
            self.settings.initial_yaw_std**2 + (curvature * self._inserted) ** 2
        )
        return covariance
