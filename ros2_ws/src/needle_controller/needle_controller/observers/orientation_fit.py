"""The start's orientation from all tips so far, in closed form, in constant memory.

For known inputs the model of [KC09] (2) has no noise of its own, so every tip is

    p_k = p_0 + R_0 c_k(u, kappa)

with c_k exact and known but for kappa: one rotation and one shift explain the whole history. The
best ones, weighted by how well each tip was measured, are a Procrustes problem: with centred sums,
R_0 maximises trace(R_0^T sum w p c^T), and one 3 x 3 singular value decomposition gives it. What is
known of the start enters as pseudo-observations: the entry point as a tip at c = 0, the orientation
as directions R_0 e_i, seen with weights that make its precision about the body axes what it should
be. The sums are carried along, so that neither memory nor time grow with the history.

kappa is estimated by doing this for a grid of curvatures at once; each weighs what its residual and
the prior say.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from needle_common.errors import OutOfBoundsError
from needle_controller.model.arc_motion import InputHistory, RelativeMotion, arc, no_motion
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import angles_from_rotation, rotation_from_angles
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.grid_pose import GridPoseCovariance, apply, nearest_rotation, pick
from needle_controller.observers.innovation_gate import InnovationGate
from needle_controller.observers.pose_settings import (
    PoseSettings,
    start_rotation_precision,
    turned_cross,
)


@dataclasses.dataclass(frozen=True)
class OrientationFitSettings(PoseSettings):
    """What the fit assumes, beside `PoseSettings`.

    Attributes
    ----------
    curvatures : int
        Curvatures that are tried, evenly spaced over +-2.5 standard deviations; 1 takes the
        curvature as known.
    entry_std : float
        How well the place of the first tip is known beforehand, as for the first tip itself if it
        is the same as `measurement_std` [m].
    """

    curvatures: int = 1
    entry_std: float = PoseSettings.measurement_std

    def __post_init__(self) -> None:
        """Check every field."""
        super().__post_init__()
        if not 1 <= self.curvatures <= 101:
            raise OutOfBoundsError("curvatures", self.curvatures, 1, 101, "-")
        if not 0.0 < self.entry_std < np.inf:
            raise OutOfBoundsError(
                "entry_std", self.entry_std, float(np.nextafter(0.0, 1.0)), np.inf, "m"
            )

    def curvature_grid(self) -> Array:
        """Return the curvatures that are tried, shape (curvatures,) [1/m]."""
        if self.curvatures == 1:
            return np.array([self.curvature])
        least, most = self.curvature_range
        span = 2.5 * self.curvature_spread
        shares = np.linspace(max(1.0 - span, least), min(1.0 + span, most), self.curvatures)
        return np.asarray(self.curvature * shares)


@dataclasses.dataclass
class _Sums:
    """Weighted sums over the tips; a trailing axis of curvatures where they depend on it."""

    weight: Array  # (...)
    tip: Array  # (..., 3)
    tip_squared: Array  # (...)
    arm: Array  # (..., G, 3): c
    outer: Array  # (..., G, 3, 3): c c^T
    cross: Array  # (..., G, 3, 3): p c^T

    def add(self, weight: Array, tip: Array, arm: Array) -> None:
        """Add tips, shape (..., 3), with arms, shape (..., G, 3)."""
        of_grid = weight[..., None, None]
        self.weight = self.weight + weight
        self.tip = self.tip + weight[..., None] * tip
        self.tip_squared = self.tip_squared + weight * np.sum(tip * tip, axis=-1)
        self.arm = self.arm + of_grid * arm
        weighted = of_grid * arm
        self.outer = self.outer + weighted[..., :, None] * arm[..., None, :]
        self.cross = self.cross + tip[..., None, :, None] * weighted[..., None, :]


class OrientationFit:
    """Estimates the start's pose from the whole history, and carries it through the inputs.

    See `estimator.Estimator`. The model is taken at its word: torsion or a curvature that changes
    on the way are not in it, and what they did long ago is never forgotten.

    Parameters
    ----------
    settings : OrientationFitSettings
        What is assumed.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`;
        identity by default.
    """

    def __init__(
        self, settings: OrientationFitSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self.settings = settings
        self.initial_rotation: Array = (
            np.eye(3) if initial_rotation is None else np.asarray(initial_rotation, dtype=float)
        )
        self._grid = settings.curvature_grid()
        self._gate = InnovationGate(settings.gate)
        self._history = InputHistory()
        self.reset(np.zeros(3), np.zeros(2))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        tip, joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        shape, count = np.broadcast_shapes(tip.shape[:-1], joints.shape[:-1]), len(self._grid)
        turned = np.zeros((*shape, 3))
        turned[..., 2] = joints[..., 1]
        start = self.initial_rotation @ rotation_from_angles(turned)
        a = start_rotation_precision(self.settings)
        # Directions R_0 e_i seen with weights w: the precision about axis j is the others' sum.
        weights = 0.5 * np.sum(a) - a
        self._prior_cross: Array = start * weights
        self._sums = _Sums(
            weight=np.zeros(shape),
            tip=np.zeros((*shape, 3)),
            tip_squared=np.zeros(shape),
            arm=np.zeros((*shape, count, 3)),
            outer=np.zeros((*shape, count, 3, 3)),
            cross=np.zeros((*shape, count, 3, 3)),
        )
        self._motion: RelativeMotion = no_motion()
        self._history.clear()
        self._gate.reset()
        # Sums of squares are taken about the first tip, lest they cancel far from the origin.
        self._origin: Array = np.where(np.isfinite(tip), tip, 0.0) + np.zeros((*shape, 3))
        entry = np.full(shape, self.settings.entry_std**-2.0)
        self._sums.add(entry, np.zeros((*shape, 3)), np.zeros((*shape, count, 3)))
        self._fit()

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        length, turn = np.asarray(d_insertion, dtype=float), np.asarray(d_rotation, dtype=float)
        if not (np.all(np.isfinite(length)) and np.all(length >= 0.0)):
            raise ValueError(f"d_insertion = {length} m, wants finite and >= 0")
        if not np.all(np.isfinite(turn)):
            raise ValueError(f"d_rotation = {turn} rad, wants finite")
        # With a trailing axis, that of the curvatures.
        length, turn = length[..., None], turn[..., None]
        self._history.add(length, turn)
        self._motion = self._motion.then(arc(length, turn, self._grid))

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`.

        A tip weighs 3 / trace(covariance): a rotation's closed form wants the same weight in all
        directions. The gate uses the covariance as it is.
        """
        tip, age = np.asarray(tip, dtype=float) - self._origin, np.asarray(age, dtype=float)
        found = np.all(np.isfinite(tip), axis=-1)
        noise = np.eye(3) * self.settings.measurement_std**2
        if covariance is not None:
            noise = np.asarray(covariance, dtype=float)
            finite = np.all(np.isfinite(noise), axis=(-1, -2))
            found = found & finite
            noise = np.where(finite[..., None, None], noise, np.eye(3))
        arm = self._motion.shift
        if np.any(age > 0.0):
            back = self._history.motion_back(age[..., None], self._grid)
            arm = self._motion.then(back).shift
        best = self._best
        arms = np.broadcast_to(arm, self._sums.arm.shape)
        at_best = pick(arms, best)
        rotation = pick(self._rotation, best)
        expected = pick(self._position, best) + apply(rotation, at_best)
        innovation = np.where(found[..., None], tip - expected, 0.0)
        j = np.concatenate(
            [np.broadcast_to(np.eye(3), rotation.shape), turned_cross(rotation, at_best)], axis=-1
        )
        spread = j @ self._start_covariance(best) @ np.swapaxes(j, -1, -2) + noise
        if len(self._grid) > 1:
            # Until the curvature is known, it is part of what the tip may be off by.
            motion_slope = np.broadcast_to(self._motion.shift_slope, self._sums.arm.shape)
            slope = apply(rotation, pick(motion_slope, best))
            variance = self._curvature_variance()[..., None, None]
            spread = spread + slope[..., :, None] * slope[..., None, :] * variance
        distance = np.sum(innovation * apply(np.linalg.inv(spread), innovation), axis=-1)
        used = self._gate.admit(distance, found)
        weight = np.where(used, 3.0 / np.trace(noise, axis1=-2, axis2=-1), 0.0)
        self._sums.add(weight, np.where(used[..., None], tip, 0.0), arms)
        self._fit()

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        weights = self._weights()
        grid_shape = self._sums.arm.shape
        position = self._position + apply(
            self._rotation, np.broadcast_to(self._motion.shift, grid_shape)
        )
        rotation = self._rotation @ self._motion.rotation
        mean_position = np.sum(weights[..., None] * position, axis=-2) + self._origin
        mean_rotation = nearest_rotation(np.sum(weights[..., None, None] * rotation, axis=-3))
        curvature = np.sum(weights * self._grid, axis=-1)
        angles = angles_from_rotation(mean_rotation)
        reduced = np.stack([mean_position[..., 0], angles[..., 1], angles[..., 2]], axis=-1)
        pose_covariance = self._covariance_of(weights, position, rotation, mean_rotation)
        return Estimate(
            coordinates=np.concatenate([mean_position, angles], axis=-1),
            linearized=linearized_from_reduced(reduced, curvature),
            curvature=curvature,
            warnings=self._gate.warnings(),
            covariance_of=pose_covariance,
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn = transform[:3, :3]
        sums = self._sums
        self._origin = self._origin @ turn.T + transform[:3, 3]
        self._prior_cross = turn @ self._prior_cross
        self.initial_rotation = turn @ self.initial_rotation
        self._sums = dataclasses.replace(sums, tip=sums.tip @ turn.T, cross=turn @ sums.cross)
        self._fit()

    def _fit(self) -> None:
        """Solve for the start's pose, for every curvature of the grid."""
        sums = self._sums
        weight = sums.weight[..., None]
        tip = sums.tip[..., None, :] / weight[..., None]
        arm = sums.arm / weight[..., None]
        centred = sums.cross - weight[..., None, None] * tip[..., :, None] * arm[..., None, :]
        moment = centred + self._prior_cross[..., None, :, :]
        self._rotation = nearest_rotation(moment)
        self._position = tip - apply(self._rotation, arm)
        # Half the weighted sum of squares, but for what no rotation changes.
        spread = sums.tip_squared - np.sum(sums.tip**2, axis=-1) / sums.weight
        arms = np.trace(sums.outer, axis1=-2, axis2=-1) - weight * np.sum(arm**2, axis=-1)
        gained = np.sum(self._rotation * moment, axis=(-2, -1))
        self._cost = 0.5 * (spread[..., None] + arms) - gained
        if len(self._grid) > 1:
            std = self.settings.curvature_spread * self.settings.curvature
            self._cost = self._cost + 0.5 * ((self._grid - self.settings.curvature) / std) ** 2
        self._best: npt.NDArray[np.int64] = np.argmin(self._cost, axis=-1)

    def _weights(self) -> Array:
        """Return how likely each curvature is, shape (..., G)."""
        weights = np.exp(np.min(self._cost, axis=-1, keepdims=True) - self._cost)
        return np.asarray(weights / np.sum(weights, axis=-1, keepdims=True))

    def _curvature_variance(self) -> Array:
        weights = self._weights()
        mean = np.sum(weights * self._grid, axis=-1, keepdims=True)
        return np.asarray(np.sum(weights * (self._grid - mean) ** 2, axis=-1))

    def _start_covariance(self, index: npt.NDArray[np.int64]) -> Array:
        """Return the covariance of (position, body rotation vector) of the start, (..., 6, 6)."""
        sums = self._sums
        arm, outer = pick(sums.arm, index), pick(sums.outer, index)
        rotation = pick(self._rotation, index)
        precision = np.zeros((*sums.weight.shape, 6, 6))
        precision[..., :3, :3] = sums.weight[..., None, None] * np.eye(3)
        crossed = turned_cross(rotation, arm)
        precision[..., :3, 3:] = crossed
        precision[..., 3:, :3] = np.swapaxes(crossed, -1, -2)
        trace = np.trace(outer, axis1=-2, axis2=-1)[..., None, None]
        precision[..., 3:, 3:] = (
            trace * np.eye(3) - outer + np.diag(start_rotation_precision(self.settings))
        )
        return np.linalg.inv(precision)

    def _covariance_of(
        self, weights: Array, position: Array, rotation: Array, mean_rotation: Array
    ) -> GridPoseCovariance:
        best = self._best
        shape = self._sums.arm.shape
        return GridPoseCovariance(
            start=self._start_covariance(best),
            start_rotation=pick(self._rotation, best),
            shift=pick(np.broadcast_to(self._motion.shift, shape), best),
            turned=pick(np.broadcast_to(self._motion.rotation, (*shape, 3)), best),
            weights=weights,
            position=position,
            rotation=rotation,
            mean_rotation=mean_rotation,
        )
