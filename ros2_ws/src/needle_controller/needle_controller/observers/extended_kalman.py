"""Extended Kalman filter of the tip's full pose and the curvature, from x, y and z.

The error state is (position in `target_plane`, body rotation vector, curvature): the true pose is
p + dp, R exp(phi^), the true curvature kappa + dkappa. Over an advance with shift d and rotation M
([KC09] (2), `arc_motion`), exactly to first order,

    dp'  = dp - R d^ phi + R (dd/dkappa) dkappa
    phi' = M^T phi + (rotation slope) dkappa

and a tip is measured as p + dp + noise. A late tip is taken as p + R b, with b the way back over
the known inputs, and corrects the pose of now.

Linearised about a roll that is off by tens of degrees, the filter learns more than there is to
know; `orientation_drift` is what keeps its covariance honest.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_common.errors import OutOfBoundsError
from needle_controller.model.arc_motion import InputHistory, arc, rotation_exp
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import angles_from_rotation, rotation_from_angles
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.innovation_gate import InnovationGate
from needle_controller.observers.pose_settings import (
    PoseSettings,
    coordinate_covariance,
    start_rotation_precision,
    turned_cross,
)

POSITION, ROTATION, CURVATURE = slice(0, 3), slice(3, 6), 6
"""Where the parts of the error are."""
ERROR = 7


@dataclasses.dataclass(frozen=True)
class ExtendedKalmanSettings(PoseSettings):
    """What the filter assumes, beside `PoseSettings`.

    Attributes
    ----------
    orientation_drift : float
        Growth of the orientation's standard deviation over a metre [rad/sqrt(m)].
    curvature_drift : float
        Growth of the curvature's, as a share of it [1/sqrt(m)].
    """

    orientation_drift: float = 0.03
    curvature_drift: float = 0.3

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        for name, unit in (("orientation_drift", "rad/sqrt(m)"), ("curvature_drift", "1/sqrt(m)")):
            value = float(getattr(self, name))
            if not 0.0 <= value < math.inf:
                raise OutOfBoundsError(name, value, 0.0, math.inf, unit)


class ExtendedKalmanFilter:
    """Estimates the tip's pose and the curvature; see `estimator.Estimator`.

    Parameters
    ----------
    settings : ExtendedKalmanSettings
        What is assumed.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: ExtendedKalmanSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self.settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self._gate = InnovationGate(settings.gate)
        self._history = InputHistory()
        self.reset(np.zeros(3), np.zeros(2))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        settings = self.settings
        tip, joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        shape = np.broadcast_shapes(tip.shape[:-1], joints.shape[:-1])
        turned = np.zeros((*shape, 3))
        turned[..., 2] = joints[..., 1]
        self._position: Array = np.broadcast_to(tip, (*shape, 3)).copy()
        self._rotation: Array = self.initial_rotation @ rotation_from_angles(turned)
        self._curvature: Array = np.full(shape, settings.curvature)
        variances = np.concatenate(
            [
                np.full(3, settings.measurement_std**2),
                1.0 / start_rotation_precision(settings),
                [(settings.curvature_spread * settings.curvature) ** 2],
            ]
        )
        self._covariance: Array = np.broadcast_to(np.diag(variances), (*shape, ERROR, ERROR)).copy()
        self._gate.reset()
        self._history.clear()

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        length, turn = np.asarray(d_insertion, dtype=float), np.asarray(d_rotation, dtype=float)
        if not (np.all(np.isfinite(length)) and np.all(length >= 0.0)):
            raise ValueError(f"d_insertion = {length} m, wants finite and >= 0")
        if not np.all(np.isfinite(turn)):
            raise ValueError(f"d_rotation = {turn} rad, wants finite")
        self._history.add(length, turn)
        motion = arc(length, turn, self._curvature)
        f = np.zeros((*motion.shift.shape[:-1], ERROR, ERROR))
        f[...] = np.eye(ERROR)
        f[..., POSITION, ROTATION] = turned_cross(self._rotation, motion.shift)
        f[..., POSITION, CURVATURE] = _apply(self._rotation, motion.shift_slope)
        f[..., ROTATION, ROTATION] = np.swapaxes(motion.rotation, -1, -2)
        f[..., ROTATION, CURVATURE] = motion.rotation_slope
        covariance = f @ self._covariance @ np.swapaxes(f, -1, -2)
        settings = self.settings
        for i in range(3, 6):
            covariance[..., i, i] += settings.orientation_drift**2 * length
        drift = (settings.curvature_drift * settings.curvature) ** 2
        covariance[..., CURVATURE, CURVATURE] += drift * length
        self._covariance = covariance
        self._position = self._position + _apply(self._rotation, motion.shift)
        self._rotation = self._rotation @ motion.rotation

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`."""
        tip, age = np.asarray(tip, dtype=float), np.asarray(age, dtype=float)
        found = np.all(np.isfinite(tip), axis=-1)
        noise = np.eye(3) * self.settings.measurement_std**2
        if covariance is not None:
            noise = np.asarray(covariance, dtype=float)
            finite = np.all(np.isfinite(noise), axis=(-1, -2))
            found = found & finite
            noise = np.where(finite[..., None, None], noise, np.eye(3))
        h = np.zeros((*self._position.shape, ERROR))
        h[..., :, POSITION] = np.eye(3)
        expected = self._position
        if np.any(age > 0.0):
            back = self._history.motion_back(age, self._curvature)
            expected = expected + _apply(self._rotation, back.shift)
            h[..., :, ROTATION] = turned_cross(self._rotation, back.shift)
            h[..., :, CURVATURE] = _apply(self._rotation, back.shift_slope)
        innovation = np.where(found[..., None], tip - expected, 0.0)
        crossed = self._covariance @ np.swapaxes(h, -1, -2)
        spread = h @ crossed + noise
        inverse: Array = np.asarray(np.linalg.inv(spread), dtype=float)
        distance = np.sum(innovation * _apply(inverse, innovation), axis=-1)
        used = self._gate.admit(distance, found)
        gain = crossed @ inverse * used[..., None, None]
        change = _apply(gain, innovation)
        settings = self.settings
        least, most = (share * settings.curvature for share in settings.curvature_range)
        self._position = self._position + change[..., POSITION]
        self._rotation = self._rotation @ rotation_exp(change[..., ROTATION])
        self._curvature = np.clip(self._curvature + change[..., CURVATURE], least, most)
        narrowed = self._covariance - gain @ np.swapaxes(crossed, -1, -2)
        self._covariance = 0.5 * (narrowed + np.swapaxes(narrowed, -1, -2))

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        angles = angles_from_rotation(self._rotation)
        coordinates = np.concatenate([self._position, angles], axis=-1)
        rotation, covariance = self._rotation, self._covariance
        least, most = (s * self.settings.curvature for s in self.settings.curvature_range)
        warnings = self._gate.warnings()
        if self.settings.curvature_spread > 0.0 and np.any(
            (self._curvature <= least) | (self._curvature >= most)
        ):
            warnings = (*warnings, f"the curvature is at its limit, [{least:.3g}, {most:.3g}] 1/m")
        reduced = np.stack([coordinates[..., 0], angles[..., 1], angles[..., 2]], axis=-1)
        return Estimate(
            coordinates=coordinates,
            linearized=linearized_from_reduced(reduced, self._curvature),
            curvature=self._curvature.copy(),
            warnings=warnings,
            covariance_of=lambda: coordinate_covariance(
                covariance[..., POSITION, POSITION],
                covariance[..., POSITION, ROTATION],
                covariance[..., ROTATION, ROTATION],
                rotation,
            ),
        )

    def error_covariance(self) -> Array:
        """Return the covariance of the error state, shape (..., 7, 7)."""
        return np.array(self._covariance)

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn = transform[:3, :3]
        self._position = self._position @ turn.T + transform[:3, 3]
        self._rotation = turn @ self._rotation
        self.initial_rotation = turn @ self.initial_rotation
        turns = np.eye(ERROR)
        turns[POSITION, POSITION] = turn
        self._covariance = turns @ self._covariance @ turns.T


def _apply(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))
