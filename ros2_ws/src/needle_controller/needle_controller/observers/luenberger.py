"""The paper's observer ([KC09] (9)): a constant gain on the tip's distance from the plane."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

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
from needle_core.compiled import compiled

INITIAL_YAW_STD = INITIAL_PITCH_STD = math.radians(10.0)
INITIAL_ROLL_STD = math.radians(30.0)
"""Standard deviations of the orientation at the entry, for the covariance only [rad]."""
OBSERVER = np.dtype(
    [
        ("linearized", np.float64, 3),  # s of (6)
        ("yaw", np.float64),  # by (4), not observed [rad]
        ("since_correction", np.float64),  # inserted since the last tip [m]
        ("saturated", np.bool_),  # whether the estimate was projected
    ]
)
"""State of the observer for one needle."""


class ObserverSettings(NamedTuple):
    """Assumptions of the observer.

    Attributes
    ----------
    curvature : float
        Curvature of the needle's path, kappa [1/m].
    saturation_margin : float
        Distance of the estimate from the border of the region of (6), in [0, 1).
    poles : ndarray of complex, shape (3,)
        Eigenvalues of A - L C [1/m], from `gains.design_gains`.
    process_noise : ndarray, shape (3, 3)
        Covariance of white noise on ds/dl per metre; for the covariance only.
    measurement_std : float
        Standard deviation of one measured coordinate [m]; for the covariance only.
    """

    curvature: float
    saturation_margin: float
    poles: npt.NDArray[np.complex128]
    process_noise: Array
    measurement_std: float


class LuenbergerObserver:
    """Observer (9), sampled for the actual insertion, saturated as in [KC09] IV-A.

    It starts at the first measurement with the orientation of the base: at (x, 0, 0) if the needle
    enters along the plane with roll 0. x is estimated; y and z are the last measured tip; the yaw
    is integrated from the start by (4), without observation.

    Parameters
    ----------
    settings : ObserverSettings
        Gains and assumptions.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: ObserverSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self._settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self._needle = np.zeros(1, OBSERVER)[0]
        self._inserted = 0.0
        self._tip: Array = np.zeros(3)
        self._tip_covariance: Array = np.zeros((3, 3))
        self._covariance: Array = np.zeros((3, 3))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        settings, turn = self._settings, float(np.asarray(joints, dtype=float)[1])
        self._tip = np.array(tip, dtype=float)
        start = self.initial_rotation @ rotation_from_angles([0.0, 0.0, turn])
        self._set_pose(float(self._tip[0]), start)
        self._needle["since_correction"] = self._inserted = 0.0
        self._tip_covariance = np.eye(3) * settings.measurement_std**2
        stds = (
            settings.measurement_std,
            INITIAL_PITCH_STD,
            settings.curvature * INITIAL_ROLL_STD,
        )
        self._covariance = np.diag(np.square(stds))

    def advance(self, d_insertion: float, d_rotation: float) -> None:
        """Advance by the actual motion; see `Estimator.advance`."""
        length = float(d_insertion)
        if not (math.isfinite(length) and length >= 0.0):
            raise ValueError(f"d_insertion = {length!r} m, expected finite and >= 0")
        advance_observer(self._needle, length, float(d_rotation), self._settings)
        self._inserted += length
        # P <- F P F^T + Q
        f = transition(length)
        added = process_covariance(self._settings.process_noise, length)
        self._covariance = f @ self._covariance @ f.T + added

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: float = 0.0
    ) -> None:
        """Correct by a measured tip; see `Estimator.correct`.

        The constant gain does not use `covariance`, which only enters the estimate's covariance.
        The tip `age` ago is x - age s2 + age^2 / 2 s3.
        """
        measured_tip, noise = np.array(tip, dtype=float), self._settings.measurement_std**2
        found = bool(np.all(np.isfinite(measured_tip)))
        if covariance is not None:
            known = np.array(covariance, dtype=float)
            noise = float(known[0, 0])
            found = found and math.isfinite(noise)
        if not found:
            return
        since = float(self._needle["since_correction"])
        of_each = sampled_observer_gain(self._settings.poles, since)
        correct_observer(self._needle, float(measured_tip[0]), float(age), of_each, self._settings)
        gain = np.array(of_each)
        self._tip = measured_tip
        if covariance is not None:
            self._tip_covariance = known
        # P <- (I - L c) P (I - L c)^T + L r L^T, c the row of F(-age) that gives x
        keep = np.eye(3) - np.outer(gain, transition(-float(age))[0])
        self._covariance = keep @ self._covariance @ keep.T + noise * np.outer(gain, gain)

    def estimate(self) -> Estimate:
        """Return the present estimate; see `Estimator.estimate`."""
        curvature, s = self._settings.curvature, np.array(self._needle["linearized"])
        x, pitch, roll = reduced_from_linearized(s, curvature)
        yaw = float(self._needle["yaw"])
        warnings: tuple[str, ...] = ()
        if self._needle["saturated"]:
            warnings = (
                "the estimate was saturated: its roll is beyond the range of its coordinates",
            )
        return Estimate(
            coordinates=np.array([x, self._tip[1], self._tip[2], yaw, pitch, roll]),
            linearized=s,
            curvature=curvature,
            covariance=self._coordinate_covariance(np.array([x, pitch, roll])),
            warnings=warnings,
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Transform everything into another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn, shift = transform[:3, :3], transform[:3, 3]
        known = self.estimate()
        self._tip = turn @ self._tip + shift
        self._tip_covariance = turn @ self._tip_covariance @ turn.T
        self.initial_rotation = turn @ self.initial_rotation
        self._set_pose(float((turn @ known.position + shift)[0]), turn @ known.rotation)

    def _set_pose(self, x: float, rotation: Array) -> None:
        yaw, pitch, roll = angles_from_rotation(rotation)
        self._needle["linearized"] = linearized_from_reduced(
            np.array([x, pitch, roll]), self._settings.curvature
        )
        self._needle["yaw"] = yaw
        saturate(self._needle, self._settings)

    def _coordinate_covariance(self, reduced: Array) -> Array:
        """Return the covariance of q, to first order."""
        curvature = self._settings.curvature
        covariance = np.zeros((6, 6))
        index = np.array([0, 4, 5])
        covariance[index[:, None], index[None, :]] = reduced_covariance(
            self._covariance, reduced, curvature
        )
        covariance[1:3, 1:3] = self._tip_covariance[1:3, 1:3]
        # The yaw is not observed: its initial variance, and all the yaw that wrong rolls can cause.
        covariance[YAW, YAW] = INITIAL_YAW_STD**2 + (curvature * self._inserted) ** 2
        return covariance


@compiled
def saturation_factor(s2: float, sine: float, margin: float) -> float:
    """Return the factor that scales s2 and s3 / kappa into s2^2 + (s3 / kappa)^2 <= 1 - margin."""
    squared = s2 * s2 + sine * sine
    if squared > 1.0 - margin:
        return math.sqrt((1.0 - margin) / squared)
    return 1.0


@compiled
def saturate(needle: Any, settings: ObserverSettings) -> None:
    """Project s radially onto s2^2 + (s3 / kappa)^2 <= 1 - margin ([KC09] IV-A).

    In this region s has a pitch and a roll within +-90 deg; s1 is free. In the coordinates (s2, s3
    / kappa) it is a disc, and the projection is the closest point, as in the paper: [0, 1.5, 0]
    becomes [0, 1, 0] without margin. The inverse of (7) divides by cos(pitch) cos(roll) >=
    sqrt(margin).
    """
    s = needle.linearized
    scale = saturation_factor(s[1], s[2] / settings.curvature, settings.saturation_margin)
    needle.saturated = scale < 1.0
    s[1] *= scale
    s[2] *= scale


@compiled
def advance_observer(needle: Any, length: float, turn: float, settings: ObserverSettings) -> None:
    """Advance the linearized state by the actual motion: A s + B v of (9).

    v is constant over the length, with the value that leads to the same roll as (5) with u: (7) for
    short steps, and finite even for a rotation without insertion. s cannot follow beyond +-90 deg.

    Parameters
    ----------
    needle : OBSERVER, changed
        The needle.
    length, turn : float
        Inserted length [m] and rotation of the base [rad].
    settings : ObserverSettings
        Assumptions.
    """
    s, kappa = needle.linearized, settings.curvature
    s2, s3 = s[1], s[2]
    # In the region of (6), cos(pitch) and cos(roll) are positive square roots.
    cos_pitch = math.sqrt(1.0 - s2 * s2)
    sin_roll = s3 / (kappa * cos_pitch)
    cos_roll = math.sqrt(max(1.0 - sin_roll * sin_roll, 0.0))
    # droll = u l - kappa cos(roll) tan(pitch) l, (5)
    turn -= kappa * cos_roll * s2 / cos_pitch * length
    sin_turn, cos_turn = math.sin(turn), math.cos(turn)
    sin_turned = sin_roll * cos_turn + cos_roll * sin_turn
    # |roll| <= 90 deg: a turn beyond +-90 deg ends at that side.
    if cos_roll * cos_turn - sin_roll * sin_turn < 0.0 or abs(turn) >= math.pi:
        sin_turned = math.copysign(1.0, turn)
    sin_pitched = s2 + length * s3
    cos_pitched = math.sqrt(max(1.0 - sin_pitched * sin_pitched, 0.0))
    # s(l) of (8) with v l = kappa cos(pitch) sin(roll) - s3
    added = kappa * cos_pitched * sin_turned - s3
    s[0] += length * s2 + length * length * (0.5 * s3 + added / 6.0)
    s[1] = s2 + length * (s3 + 0.5 * added)
    s[2] = s3 + added
    saturate(needle, settings)
    # dyaw = kappa cos(roll) / cos(pitch) l, (4), trapezoidal
    squared = 1.0 - s[1] * s[1]
    slope = cos_roll / cos_pitch + math.sqrt(squared - (s[2] / kappa) ** 2) / squared
    needle.yaw += 0.5 * length * kappa * slope
    needle.since_correction += length


@compiled
def correct_observer(
    needle: Any, x: float, age: float, gain: tuple[float, float, float], settings: ObserverSettings
) -> None:
    """Correct the linearized state by a measured distance from the plane: (9).

    Parameters
    ----------
    needle : OBSERVER, changed
        The needle.
    x : float
        Distance of the tip [m].
    age : float
        Insertion since its exposure [m].
    gain : tuple of float
        L, from `sampled_observer_gain` over the insertion since the last correction.
    settings : ObserverSettings
        Assumptions.
    """
    s = needle.linearized
    # s <- s + L (w - C F(-age) s)
    innovation = x - (s[0] - age * s[1] + 0.5 * age * age * s[2])
    s[0] += gain[0] * innovation
    s[1] += gain[1] * innovation
    s[2] += gain[2] * innovation
    saturate(needle, settings)
    needle.since_correction = 0.0
