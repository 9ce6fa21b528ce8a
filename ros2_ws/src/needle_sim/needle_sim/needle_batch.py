"""Many needles at once, compiled: the plant of a study, step for step that of `plant.NeedlePlant`.

It follows [KC09] (1)-(2) with the unicycle's tip (l2 = 0): one combined twist a call. It keeps no
channel: studies only insert.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from needle_common.compiled import compiled
from needle_sim.se3 import FloatArray
from needle_sim.tissue import Torsion

# Square of the largest angle of one step for which the series below are exact to the last digit.
_SERIES_UP_TO = 0.5
_TERMS = 9
# Their coefficients, the highest power first.
_FIRST = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in reversed(range(_TERMS)))
_SECOND = tuple((-1.0) ** k / math.factorial(2 * k + 2) for k in reversed(range(_TERMS)))
_THIRD = tuple((-1.0) ** k / math.factorial(2 * k + 3) for k in reversed(range(_TERMS)))


class NeedleBatch:
    """The tips of many needles, from their starts on.

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
        """The tips' distance from the plane, shape (N,) [m]; a view."""
        return np.asarray(self._position[0])

    @property
    def tips(self) -> FloatArray:
        """The tips, shape (N, 3) [m]; a view."""
        return np.asarray(self._position.T)

    @property
    def T_rig_tip(self) -> FloatArray:  # noqa: N802
        """The tips' poses, shape (N, 4, 4) [m]."""
        count = self._position.shape[1]
        poses = np.zeros((count, 4, 4))
        poses[:, :3, :3] = self._rotation.T.reshape(count, 3, 3)
        poses[:, :3, 3] = self._position.T
        poses[:, 3, 3] = 1.0
        return poses

    def advance(self, d_insertion: float, d_rotation: ArrayLike, curvature: ArrayLike) -> None:
        """Insert all needles by one length, and turn each base over it.

        Parameters
        ----------
        d_insertion : float
            Insertion, >= 0 [m].
        d_rotation : array_like, shape (N,)
            Rotation of each base [rad].
        curvature : array_like, shape (N,) or ()
            kappa of each needle's path over that length [1/m].
        """
        turned = np.asarray(d_rotation, dtype=np.float64)
        if self._torsion is not None:
            turned = self._torsion.advance(d_insertion, turned)
        shape = self._position.shape[1:]
        _cut(
            self._position,
            self._rotation,
            float(d_insertion),
            np.ascontiguousarray(np.broadcast_to(turned, shape)),
            np.ascontiguousarray(np.broadcast_to(np.asarray(curvature, dtype=np.float64), shape)),
        )


@compiled
def _coefficients(square: float) -> tuple[float, float, float]:
    """Return sin(a)/a, (1 - cos a)/a^2 and (a - sin a)/a^3 for a^2."""
    if square > _SERIES_UP_TO:
        angle = np.sqrt(square)
        first = np.sin(angle) / angle
        half = np.sin(0.5 * angle) / angle
        return first, 2.0 * half * half, (1.0 - first) / square
    first = second = third = 0.0
    for k in range(_TERMS):
        first = first * square + _FIRST[k]
        second = second * square + _SECOND[k]
        third = third * square + _THIRD[k]
    return first, second, third


@compiled
def _cut(
    position: FloatArray,
    rotation: FloatArray,
    length: float,
    turned: FloatArray,
    curvature: FloatArray,
) -> None:
    """Move each tip by exp((V1 length + V2 turned)^) of (2), in closed form.

    With omega = (bend, 0, turn) and K its cross-product matrix, the rotation is I + first K +
    second K^2, and the translation length times the last column of I + second K + third K^2.
    """
    for i in range(turned.shape[0]):
        bend = curvature[i] * length
        turn = turned[i]
        square = bend * bend + turn * turn
        first, second, third = _coefficients(square)
        e00 = 1.0 - second * turn * turn
        e01 = -first * turn
        e02 = second * bend * turn
        e11 = 1.0 - second * square
        e12 = -first * bend
        e22 = 1.0 - second * bend * bend
        along0 = length * third * bend * turn
        along1 = -length * second * bend
        along2 = length * (1.0 - third * bend * bend)
        for row in range(3):
            r0 = rotation[3 * row, i]
            r1 = rotation[3 * row + 1, i]
            r2 = rotation[3 * row + 2, i]
            position[row, i] += r0 * along0 + r1 * along1 + r2 * along2
            rotation[3 * row, i] = r0 * e00 - r1 * e01 + r2 * e02
            rotation[3 * row + 1, i] = r0 * e01 + r1 * e11 - r2 * e12
            rotation[3 * row + 2, i] = r0 * e02 + r1 * e12 + r2 * e22
