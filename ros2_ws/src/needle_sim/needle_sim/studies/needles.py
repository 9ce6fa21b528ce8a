"""Many simulated needles at once, compiled, and the same needles under disturbances.

The plant follows [KC09] (1)-(2) with the unicycle model (l2 = 0), step for step like
`plant.NeedlePlant`: one combined twist per call. It keeps no channel, because studies only insert.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from needle_core.compiled import compiled
from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import (
    PATCH_LENGTH,
    BiasWalk,
    DelayLine,
    Disturbances,
    Insertion,
    bumps,
    measured,
    patch_factors,
    push_axes,
    roll_steps,
)

# Square of the angle of one step up to which the series below are exact to the last digit.
_MAX_SERIES_SQUARE = 0.5
_TERMS = 9
# Coefficients of the series, the highest power first.
_FIRST = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in reversed(range(_TERMS)))
_SECOND = tuple((-1.0) ** k / math.factorial(2 * k + 2) for k in reversed(range(_TERMS)))
_THIRD = tuple((-1.0) ** k / math.factorial(2 * k + 3) for k in reversed(range(_TERMS)))


class NeedleBatch:
    """Tips of many needles.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle at insertion 0; y, z and yaw are 0.
    torsion : Torsion, optional
        Torsion of the shafts; none by default.
    """

    def __init__(self, starts: FloatArray, torsion: Torsion | None = None) -> None:
        x, pitch, roll = np.asarray(starts, dtype=np.float64).T
        cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
        none = np.zeros_like(x)
        self._position: FloatArray = np.stack([x, none, none])
        # R = Ry(pitch) Rz(roll), row by row.
        self._rotation: FloatArray = np.stack(
            [cp * cr, -cp * sr, sp, sr, cr, none, -sp * cr, sp * sr, cp]
        )
        self._torsion = torsion

    @property
    def x(self) -> FloatArray:
        """Distances of the tips from the plane, shape (N,) [m]; a view."""
        return np.asarray(self._position[0])

    @property
    def tips(self) -> FloatArray:
        """Positions of the tips, shape (N, 3) [m]; a view."""
        return np.asarray(self._position.T)

    @property
    def pitch(self) -> FloatArray:
        """Pitch of the tips out of the plane, shape (N,) [rad]."""
        return np.asarray(np.arcsin(np.clip(self._rotation[2], -1.0, 1.0)))

    @property
    def T_rig_tip(self) -> FloatArray:  # noqa: N802
        """Poses of the tips, shape (N, 4, 4) [m]."""
        count = self._position.shape[1]
        poses = np.zeros((count, 4, 4))
        poses[:, :3, :3] = self._rotation.T.reshape(count, 3, 3)
        poses[:, :3, 3] = self._position.T
        poses[:, 3, 3] = 1.0
        return poses

    def shift(self, offsets: FloatArray) -> None:
        """Translate the needles by offsets, shape (N, 3) [m]."""
        self._position += offsets.T

    def rotate(self, rotations: FloatArray) -> None:
        """Rotate the headings of all needles about their tips.

        Parameters
        ----------
        rotations : ndarray, shape (N, 3)
            Rotation vectors in `rig` [rad].
        """
        angles = np.linalg.norm(rotations, axis=1)
        axes = (rotations / np.where(angles > 0.0, angles, 1.0)[:, np.newaxis]).T[:, np.newaxis]
        columns = self._rotation.reshape(3, 3, -1)
        across = np.cross(axes, columns, axis=0)
        # Rodrigues: R <- R + sin a (k x R) + (1 - cos a) k x (k x R)
        columns += np.sin(angles) * across
        columns += (1.0 - np.cos(angles)) * np.cross(axes, across, axis=0)

    def advance(
        self,
        d_insertion: ArrayLike,
        d_rotation: ArrayLike,
        curvature: ArrayLike,
        tip_rotation: ArrayLike = 0.0,
    ) -> None:
        """Insert each needle, and rotate its base over that length.

        Parameters
        ----------
        d_insertion : array_like, shape (N,) or ()
            Insertion, >= 0 [m].
        d_rotation : array_like, shape (N,)
            Rotation of each base [rad].
        curvature : array_like, shape (N,) or ()
            Curvature of each needle's path over that length [1/m].
        tip_rotation : array_like, shape (N,) or ()
            Additional random rotation of each tip over that length [rad].
        """
        turned = np.asarray(d_rotation, dtype=np.float64)
        if self._torsion is not None:
            turned = self._torsion.advance(d_insertion, turned)
        length, turned, kappa = (
            np.ascontiguousarray(np.broadcast_to(values, self._position.shape[1:]))
            for values in (
                np.asarray(d_insertion, dtype=np.float64),
                turned + np.asarray(tip_rotation, dtype=np.float64),
                np.asarray(curvature, dtype=np.float64),
            )
        )
        _cut(self._position, self._rotation, length, turned, kappa)


@compiled
def _cut(
    position: FloatArray,
    rotation: FloatArray,
    length: FloatArray,
    turned: FloatArray,
    curvature: FloatArray,
) -> None:
    """Move each tip by exp((V1 length + V2 turned)^) of (2), in closed form.

    With omega = (bend, 0, turn) and K its cross-product matrix, the rotation is I + first K +
    second K^2, and the translation length times the last column of I + second K + third K^2.
    """
    coefficients = np.empty((3, turned.shape[0]))
    _fill_coefficients(length, turned, curvature, coefficients)
    motion = (length, turned, curvature)
    _move_row(position[0], rotation[0:3], motion, coefficients)
    _move_row(position[1], rotation[3:6], motion, coefficients)
    _move_row(position[2], rotation[6:9], motion, coefficients)


@compiled
def _fill_coefficients(
    length: FloatArray, turned: FloatArray, curvature: FloatArray, coefficients: FloatArray
) -> None:
    """Set sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 for each angle a."""
    far = 0
    for i in range(turned.shape[0]):
        bend = curvature[i] * length[i]
        square = bend * bend + turned[i] * turned[i]
        first = second = third = 0.0
        for k in range(_TERMS):
            first = first * square + _FIRST[k]
            second = second * square + _SECOND[k]
            third = third * square + _THIRD[k]
        coefficients[0, i] = first
        coefficients[1, i] = second
        coefficients[2, i] = third
        far += square > _MAX_SERIES_SQUARE
    if far == 0:
        return
    for i in range(turned.shape[0]):
        bend = curvature[i] * length[i]
        square = bend * bend + turned[i] * turned[i]
        if square > _MAX_SERIES_SQUARE:
            angle = np.sqrt(square)
            half = np.sin(0.5 * angle) / angle
            coefficients[0, i] = np.sin(angle) / angle
            coefficients[1, i] = 2.0 * half * half
            coefficients[2, i] = (1.0 - coefficients[0, i]) / square


@compiled
def _move_row(
    along_axis: FloatArray,
    row: FloatArray,
    motion: tuple[FloatArray, FloatArray, FloatArray],
    coefficients: FloatArray,
) -> None:
    """Update one coordinate of the tips and one row of their rotation matrices."""
    lengths, turned, curvature = motion
    for i in range(turned.shape[0]):
        length, turn = lengths[i], turned[i]
        bend = curvature[i] * length
        first, second, third = coefficients[0, i], coefficients[1, i], coefficients[2, i]
        r0, r1, r2 = row[0, i], row[1, i], row[2, i]
        forward = third * bend * turn * r0 - second * bend * r1 + (1.0 - third * bend * bend) * r2
        along_axis[i] += length * forward
        both = second * bend * turn
        row[0, i] = r0 * (1.0 - second * turn * turn) + r1 * (first * turn) + r2 * both
        row[1, i] = (
            r1 * (1.0 - second * (bend * bend + turn * turn))
            - r0 * (first * turn)
            + r2 * (first * bend)
        )
        row[2, i] = r0 * both - r1 * (first * bend) + r2 * (1.0 - second * bend * bend)


class DisturbedNeedles:
    """Needles of a study under its disturbances: motion and measurements.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    disturbances : Disturbances
        Disturbances of the study.
    curvature : float
        Curvature that the controller assumes [1/m].
    bump_at : float
        Insertion at which a bump, if any, moves the phantom [m].
    seed, first : int
        Keys of the random numbers: seed of the study, first needle.

    Attributes
    ----------
    true : NeedleBatch
        True states of the needles.
    """

    def __init__(
        self,
        starts: FloatArray,
        disturbances: Disturbances,
        *,
        curvature: float,
        bump_at: float,
        seed: int,
        first: int,
    ) -> None:
        wrong = disturbances
        torsion = Torsion(wrong.play, wrong.lag_length) if wrong.play or wrong.lag_length else None
        self.true = NeedleBatch(starts, torsion)
        self._disturbances = disturbances
        self._assumed = curvature * wrong.curvature_scale
        self._curvature = np.asarray(self._assumed)
        self._bump_at = bump_at
        self._key = seed, first
        self._count = len(starts)
        self._push = push_axes(wrong.push, seed, first, len(starts))
        self._bias = BiasWalk(wrong.bias_walk, seed, first, len(starts))
        self._patch = -1
        self._insertions = 0
        self._exposure = 0
        self._hidden_delay = DelayLine(wrong.hidden_delay)
        self._delay = DelayLine(wrong.delay)

    def measured(self) -> FloatArray:
        """Return the tips measured at the present exposure, (N, 3) [m]."""
        seed, first = self._key
        tips = measured(self.true.tips, self._disturbances, seed, self._exposure, first)
        return tips + self._bias.at(self._exposure) if self._disturbances.bias_walk else tips

    def insert(self, begin: float, end: float, length: ArrayLike, turned: FloatArray) -> None:
        """Move the stages from one insertion to another.

        Parameters
        ----------
        begin, end : float
            Nominal insertions of the stage, before and after the step [m].
        length : array_like, shape (N,) or ()
            Motion of each stage [m].
        turned : ndarray, shape (N,)
            Rotation of the bases [rad].
        """
        wrong, (seed, first) = self._disturbances, self._key
        patch = int((begin + 1e-9) / PATCH_LENGTH)
        if wrong.curvature_patches and patch != self._patch:
            self._patch = patch
            factors = patch_factors(wrong.curvature_patches, seed, patch, first, self._count)
            self._curvature = np.asarray(self._assumed * factors)
        curvature, (factor, begins) = self._curvature, wrong.layer
        if begin + 1e-9 >= begins:
            curvature = curvature * factor
        inserted = np.broadcast_to(np.asarray(length) / (1.0 + wrong.slip), self._count)
        self._insertions += 1
        tip_rotation: FloatArray = np.zeros(self._count)
        if wrong.roll_walk:
            tip_rotation = roll_steps(wrong.roll_walk, seed, self._insertions, first, self._count)
            tip_rotation *= np.sqrt(inserted)
        # Rotations in space and with the tip commute: half of the push before the step and half
        # after it is exact except for the position, whose error is below 1 um at the end.
        half = 0.5 * inserted[:, np.newaxis] * self._push
        if wrong.push:
            self.true.rotate(half)
        self.true.advance(inserted, wrong.rotation_gain * turned, curvature, tip_rotation)
        if wrong.push:
            self.true.rotate(half)
        if wrong.bump and begin < self._bump_at <= end:
            self.true.shift(bumps(wrong.bump, seed, first, self._count))

    def measure(self, insertion: Insertion) -> tuple[FloatArray, Insertion]:
        """Return the measurement that arrives after a step.

        Parameters
        ----------
        insertion : float, or ndarray, shape (N,)
            Insertion of the stages [m].

        Returns
        -------
        tips : ndarray, shape (N, 3)
            Measured tips [m]; NaN if nothing arrives.
        age : float, or ndarray, shape (N,)
            Insertion since the measurement, as given to the controller [m].
        """
        self._exposure += 1
        as_new, _ = self._hidden_delay.push(self.measured(), insertion)
        return self._delay.push(as_new, insertion)
