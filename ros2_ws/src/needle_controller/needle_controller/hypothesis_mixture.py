"""A bank of estimates as one: mean pose, covariance, and the table that the roll law reads."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_common.compiled import compiled
from needle_controller.arrays import Array
from needle_controller.estimator import Estimate
from needle_controller.hypothesis_bank import BEHIND_PLAY, KIND, LAG, PLAY, TIP_ANGLE, Bank
from needle_controller.kinematics import angle_axes, rotation_from_angles

(
    T_X,
    T_SIN_PITCH,
    T_ROLL,
    T_CURVATURE,
    T_TIP_ANGLE,
    T_BEHIND_PLAY,
    T_PLAY,
    T_LAG,
    T_WEIGHT,
    T_KIND,
) = range(10)
"""Columns of `Hypotheses.table`: x [m], sin(pitch), roll [rad], curvature [1/m], angles of the tip
and of the shaft behind the play since the start [rad], play [rad], lag length [m], weight, number
of the torsion hypothesis."""
COLUMNS = 10
_AMBIGUOUS_COSINE = math.cos(math.radians(60.0))
_NO_MEAN_ROLL = 0.1


@dataclasses.dataclass(frozen=True)
class Hypotheses:
    """What a law needs of a bank of estimates.

    Attributes
    ----------
    table : ndarray, shape (..., H, 10)
        One row for each hypothesis, see the `T_...` columns; weight 0 where there is none.
    base : ndarray, shape (...)
        Rotation of the base since the start [rad]; the table's angles count from there too.
    wound : ndarray, shape (...)
        Rotation of the base as the joint says it [rad].
    uncertainty : ndarray, shape (..., 3)
        Variance of x [m^2], its covariance with sin(pitch) [m], variance of sin(pitch).
    """

    table: Array
    base: Array
    wound: Array
    uncertainty: Array


@dataclasses.dataclass(frozen=True)
class MixtureEstimate(Estimate):
    """An estimate that says what it is the mean of.

    Attributes
    ----------
    hypotheses : Hypotheses
        The estimates behind it.
    """

    hypotheses: Hypotheses


@compiled
def mixture(
    bank: Bank,
    coordinates: Array,
    linearized: Array,
    curvature: Array,
    ambiguous: Array,
    table: Array,
    uncertainty: Array,
) -> None:
    """Write the means of every needle's hypotheses.

    Parameters
    ----------
    bank : Bank
        The estimates.
    coordinates : ndarray, shape (N, 6), written
        x, y, z [m] are the weighted mean; the heading is the mean heading, the roll the mean
        direction of the tip's x axis about it, the likeliest one's where those cancel.
    linearized : ndarray, shape (N, 3), written
        Mean of the linearized states (6).
    curvature : ndarray, shape (N,), written
        Mean curvature [1/m].
    ambiguous : ndarray, shape (N,), written
        Weight of the hypotheses whose roll is more than 60 deg from the likeliest one's.
    table : ndarray, shape (N, H, 10), written
        See `Hypotheses`; likewise `uncertainty`, shape (N, 3).
    """
    axis, side = np.empty(3), np.empty(3)
    for n in range(bank.alive.size):
        best = _fill_table(bank, n, table[n])
        top = bank.rotation[n, best]
        axis[:] = side[:] = 0.0
        coordinates[n] = linearized[n] = uncertainty[n] = 0.0
        curvature[n] = ambiguous[n] = 0.0
        for h in range(bank.alive[n]):
            r, p, row = bank.rotation[n, h], bank.covariance[n, h], table[n, h]
            weight = row[T_WEIGHT]
            for i in range(3):
                coordinates[n, i] += weight * bank.position[n, h, i]
                axis[i] += weight * r[i, 2]
                side[i] += weight * r[i, 0]
            curvature[n] += weight * row[T_CURVATURE]
            linearized[n, 2] -= weight * row[T_CURVATURE] * r[0, 1]
            if r[0, 0] * top[0, 0] + r[1, 0] * top[1, 0] + r[2, 0] * top[2, 0] < _AMBIGUOUS_COSINE:
                ambiguous[n] += weight
            # A turn w changes the heading's x by w_y heading_z - w_z heading_y.
            ry, rz = r[1, 2], r[2, 2]
            of_pitch = p[4, 4] * rz * rz - 2.0 * p[4, 5] * ry * rz + p[5, 5] * ry * ry
            uncertainty[n, 0] += weight * (p[0, 0] + row[T_X] * row[T_X])
            uncertainty[n, 1] += weight * (p[0, 4] * rz - p[0, 5] * ry + row[T_X] * r[0, 2])
            uncertainty[n, 2] += weight * (of_pitch + r[0, 2] * r[0, 2])
        linearized[n, 0] = coordinates[n, 0]
        linearized[n, 1] = axis[0]
        uncertainty[n, 0] -= coordinates[n, 0] * coordinates[n, 0]
        uncertainty[n, 1] -= coordinates[n, 0] * axis[0]
        uncertainty[n, 2] -= axis[0] * axis[0]
        if side[0] * side[0] + side[1] * side[1] + side[2] * side[2] < _NO_MEAN_ROLL**2:
            side[:] = top[:, 0]
        _mean_angles(axis, side, coordinates[n])


@compiled
def _fill_table(bank: Bank, n: int, table: Array) -> int:
    """Write one needle's rows; return which is the likeliest."""
    total = 0.0
    best = 0
    for h in range(bank.alive[n]):
        table[h, T_WEIGHT] = math.exp(bank.log_weight[n, h])
        total += table[h, T_WEIGHT]
        if table[h, T_WEIGHT] > table[best, T_WEIGHT]:
            best = h
    for h in range(bank.alive[n]):
        row, r, torsion = table[h], bank.rotation[n, h], bank.torsion[n, h]
        row[T_X] = bank.position[n, h, 0]
        row[T_SIN_PITCH] = r[0, 2]
        row[T_ROLL] = math.atan2(-r[0, 1], r[0, 0])
        row[T_CURVATURE] = bank.curvature[n, h]
        row[T_TIP_ANGLE] = torsion[TIP_ANGLE]
        row[T_BEHIND_PLAY] = torsion[BEHIND_PLAY]
        row[T_PLAY] = torsion[PLAY]
        row[T_LAG] = torsion[LAG]
        row[T_KIND] = torsion[KIND]
        row[T_WEIGHT] /= total
    for h in range(bank.alive[n], table.shape[0]):
        table[h] = 0.0
        table[h, T_CURVATURE] = 1.0
    return best


@compiled
def _mean_angles(axis: Array, side: Array, coordinates: Array) -> None:
    """Write yaw, pitch and roll of a mean heading and a mean x axis of the tip."""
    norm = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    x, y, z = axis[0] / norm, axis[1] / norm, axis[2] / norm
    along = side[0] * x + side[1] * y + side[2] * z
    side_x, side_y, side_z = side[0] - along * x, side[1] - along * y, side[2] - along * z
    coordinates[3] = math.atan2(-y, z)
    coordinates[4] = math.asin(min(max(x, -1.0), 1.0))
    # R's first row is (cos(pitch) cos(roll), -cos(pitch) sin(roll), sin(pitch)).
    coordinates[5] = math.atan2(-(y * side_z - z * side_y), side_x)


@compiled
def _spread(bank: Bank, position: Array, rotation: Array, covariance: Array) -> None:
    """Write the covariance (N, 6, 6) of position and rotation vector about a pose."""
    error = np.empty(6)
    for n in range(bank.alive.size):
        total = 0.0
        for h in range(bank.alive[n]):
            total += math.exp(bank.log_weight[n, h])
        covariance[n] = 0.0
        for h in range(bank.alive[n]):
            weight = math.exp(bank.log_weight[n, h]) / total
            # The rotation that takes the mean to this one, as a vector.
            difference = bank.rotation[n, h] @ rotation[n].T
            cosine = 0.5 * (difference[0, 0] + difference[1, 1] + difference[2, 2] - 1.0)
            angle = math.acos(min(max(cosine, -1.0), 1.0))
            scale = 0.5
            if angle > 1e-6:
                scale = 0.5 * angle / max(math.sin(angle), 1e-6)
            error[0:3] = bank.position[n, h] - position[n]
            error[3] = scale * (difference[2, 1] - difference[1, 2])
            error[4] = scale * (difference[0, 2] - difference[2, 0])
            error[5] = scale * (difference[1, 0] - difference[0, 1])
            for i in range(6):
                for j in range(6):
                    covariance[n, i, j] += weight * (
                        bank.covariance[n, h, i, j] + error[i] * error[j]
                    )


def mixture_covariance(bank: Bank, coordinates: Array) -> Array:
    """Return the covariance of the mixture about its mean.

    Parameters
    ----------
    bank : Bank
        The estimates.
    coordinates : ndarray, shape (N, 6)
        Their mean, as `mixture` gives it.

    Returns
    -------
    ndarray, shape (N, 6, 6)
        Of x, y, z, yaw, pitch, roll; singular coordinates at pitch +-pi/2.
    """
    covariance = np.empty((len(coordinates), 6, 6))
    rotation = rotation_from_angles(coordinates[:, 3:])
    _spread(bank, np.ascontiguousarray(coordinates[:, :3]), rotation, covariance)
    to_angles = np.zeros_like(covariance)
    to_angles[:, :3, :3] = np.eye(3)
    to_angles[:, 3:, 3:] = np.linalg.inv(angle_axes(coordinates[:, 3:]))
    return np.asarray(to_angles @ covariance @ np.swapaxes(to_angles, -1, -2))
