"""A bank of estimates as one: mean pose, covariance, and the table that the roll law reads."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_common.compiled import compiled
from needle_controller.bank.hypothesis_bank import Bank
from needle_controller.bank.hypothesis_lanes import (
    BEHIND_PLAY,
    KAPPA,
    KIND,
    LAG,
    LANES,
    P00,
    P40,
    P44,
    P50,
    P54,
    P55,
    PLAY,
    R00,
    R01,
    R02,
    R10,
    R12,
    R20,
    R22,
    TIP_ANGLE,
    WEIGHT,
    X,
    Y,
    Z,
    covariances,
    rows,
)
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angle_axes, rotation_from_angles
from needle_controller.observers.estimator import Estimate

(
    T_ROLL,
    T_AGREEMENT,
    T_CURVATURE,
    T_TIP_ANGLE,
    T_BEHIND_PLAY,
    T_PLAY,
    T_LAG,
    T_WEIGHT,
) = range(8)
"""Columns of `Hypotheses.table`: mean direction of roll [rad], how the rolls agree (0..1),
curvature [1/m], angles of the tip and of the shaft behind the play since the start [rad], play
[rad], lag length [m], weight."""
COLUMNS = 8
(
    S_WEIGHT,
    S_X,
    S_Y,
    S_Z,
    S_HEADING_X,
    S_HEADING_Y,
    S_HEADING_Z,
    S_SIDE_X,
    S_SIDE_Y,
    S_SIDE_Z,
    S_BEND,
    S_CURVATURE,
    S_X_X,
    S_X_PITCH,
    S_PITCH_PITCH,
) = range(0, 15 * LANES, LANES)
"""Rows of a needle's sums over its hypotheses: weight; by weight: the tip, its heading and its x
axis, s3, curvature, and products of x and sin(pitch)."""
SUMS = 15
_AMBIGUOUS_COSINE = math.cos(math.radians(60.0))
_NO_MEAN_ROLL = 0.1


@dataclasses.dataclass(frozen=True)
class Hypotheses:
    """What a law needs of a bank of estimates.

    Attributes
    ----------
    table : ndarray, shape (..., K, 8)
        One row for each torsion hypothesis, the mean over its rolls, see the `T_...` columns;
        weight 0 where nothing is left of it.
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
    table : ndarray, shape (N, K, 8), written
        See `Hypotheses`; likewise `uncertainty`, shape (N, 3).
    """
    sums, axis, side = np.empty(SUMS * LANES), np.empty(3), np.empty(3)
    for n in range(bank.alive.size):
        state, alive = bank.state[n], bank.alive[n]
        sums[:] = 0.0
        for b in range((alive + LANES - 1) // LANES):
            _add_block(state[b], sums)
        best = _fill_table(state, alive, table[n])
        one = 1.0 / _total(sums, S_WEIGHT)
        for k in range(3):
            coordinates[n, k] = one * _total(sums, S_X + k * LANES)
            axis[k] = one * _total(sums, S_HEADING_X + k * LANES)
            side[k] = one * _total(sums, S_SIDE_X + k * LANES)
        x, sin_pitch = coordinates[n, 0], axis[0]
        linearized[n, 0], linearized[n, 1] = x, sin_pitch
        linearized[n, 2] = one * _total(sums, S_BEND)
        curvature[n] = one * _total(sums, S_CURVATURE)
        uncertainty[n, 0] = one * _total(sums, S_X_X) - x * x
        uncertainty[n, 1] = one * _total(sums, S_X_PITCH) - x * sin_pitch
        uncertainty[n, 2] = one * _total(sums, S_PITCH_PITCH) - sin_pitch * sin_pitch
        ambiguous[n] = one * _elsewhere(state, alive, best)
        if side[0] * side[0] + side[1] * side[1] + side[2] * side[2] < _NO_MEAN_ROLL**2:
            top, i = state[best // LANES], best % LANES
            side[0], side[1], side[2] = top[R00 + i], top[R10 + i], top[R20 + i]
        _mean_angles(axis, side, coordinates[n])


@compiled
def _add_block(p: Array, sums: Array) -> None:
    """Add what eight hypotheses have, by weight, lane by lane; what has no weight adds nothing."""
    for h in range(LANES):
        weight, x, bend = p[WEIGHT + h], p[X + h], p[KAPPA + h] * p[R01 + h]
        rx, ry, rz = p[R02 + h], p[R12 + h], p[R22 + h]
        sums[S_WEIGHT + h] += weight
        sums[S_X + h] += weight * x
        sums[S_Y + h] += weight * p[Y + h]
        sums[S_Z + h] += weight * p[Z + h]
        sums[S_HEADING_X + h] += weight * rx
        sums[S_HEADING_Y + h] += weight * ry
        sums[S_HEADING_Z + h] += weight * rz
        sums[S_SIDE_X + h] += weight * p[R00 + h]
        sums[S_SIDE_Y + h] += weight * p[R10 + h]
        sums[S_SIDE_Z + h] += weight * p[R20 + h]
        sums[S_BEND + h] -= weight * bend
        sums[S_CURVATURE + h] += weight * p[KAPPA + h]
        # A turn w changes the heading's x by w_y heading_z - w_z heading_y.
        of_pitch = p[P44 + h] * rz * rz - 2.0 * p[P54 + h] * ry * rz + p[P55 + h] * ry * ry
        sums[S_X_X + h] += weight * (p[P00 + h] + x * x)
        sums[S_X_PITCH + h] += weight * (p[P40 + h] * rz - p[P50 + h] * ry + x * rx)
        sums[S_PITCH_PITCH + h] += weight * (of_pitch + rx * rx)


@compiled
def _total(sums: Array, row: int) -> float:
    total = 0.0
    for h in range(LANES):
        total += sums[row + h]
    return total


@compiled
def _fill_table(state: Array, alive: int, table: Array) -> int:
    """Write the means of every torsion hypothesis; return which hypothesis is the heaviest."""
    table[:] = 0.0
    whole = heaviest = 0.0
    best = 0
    for h in range(alive):
        p, i = state[h // LANES], h % LANES
        weight = p[WEIGHT + i]
        whole += weight
        if weight > heaviest:
            heaviest, best = weight, h
        row = table[int(p[KIND + i])]
        across = weight / math.sqrt(p[R00 + i] * p[R00 + i] + p[R01 + i] * p[R01 + i])
        row[T_WEIGHT] += weight
        row[T_ROLL] -= across * p[R01 + i]
        row[T_AGREEMENT] += across * p[R00 + i]
        row[T_CURVATURE] += weight * p[KAPPA + i]
        row[T_TIP_ANGLE] += weight * p[TIP_ANGLE + i]
        row[T_BEHIND_PLAY] += weight * p[BEHIND_PLAY + i]
        row[T_PLAY] += weight * p[PLAY + i]
        row[T_LAG] += weight * p[LAG + i]
    for k in range(table.shape[0]):
        row = table[k]
        if row[T_WEIGHT] == 0.0:
            continue
        per_weight = 1.0 / row[T_WEIGHT]
        across, along = row[T_ROLL], row[T_AGREEMENT]
        row[T_ROLL] = math.atan2(across, along)
        row[T_AGREEMENT] = math.sqrt(along * along + across * across) * per_weight
        row[T_CURVATURE] *= per_weight
        row[T_TIP_ANGLE] *= per_weight
        row[T_BEHIND_PLAY] *= per_weight
        row[T_PLAY] *= per_weight
        row[T_LAG] *= per_weight
        row[T_WEIGHT] /= whole
    return best


@compiled
def _elsewhere(state: Array, alive: int, best: int) -> float:
    """Return the weight of hypotheses whose roll is more than 60 deg from one's."""
    top, i = state[best // LANES], best % LANES
    weight = 0.0
    for h in range(alive):
        p, j = state[h // LANES], h % LANES
        along = top[R00 + i] * p[R00 + j] + top[R10 + i] * p[R10 + j] + top[R20 + i] * p[R20 + j]
        if along < _AMBIGUOUS_COSINE:
            weight += p[WEIGHT + j]
    return weight


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
    weights = rows(bank.state, WEIGHT, 1)
    weights = weights * (np.arange(weights.shape[1]) < bank.alive[:, None])[..., None]
    weights /= np.sum(weights, axis=1, keepdims=True)
    rotation = rotation_from_angles(coordinates[:, None, 3:])
    turned = rows(bank.state, R00, 9).reshape(*weights.shape[:2], 3, 3)
    # The rotation that takes the mean to each one, as a vector.
    difference = turned @ np.swapaxes(rotation, -1, -2)
    cosine = 0.5 * (np.trace(difference, axis1=-2, axis2=-1) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    scale = 0.5 / np.maximum(np.sinc(angle / np.pi), 1e-6)
    error = np.empty((*weights.shape[:2], 6))
    error[..., :3] = rows(bank.state, X, 3) - coordinates[:, None, :3]
    error[..., 3] = scale * (difference[..., 2, 1] - difference[..., 1, 2])
    error[..., 4] = scale * (difference[..., 0, 2] - difference[..., 2, 0])
    error[..., 5] = scale * (difference[..., 1, 0] - difference[..., 0, 1])
    of_each = covariances(bank.state)[..., :6, :6] + error[..., :, None] * error[..., None, :]
    covariance = np.sum(weights[..., None] * of_each, axis=1)
    to_angles = np.zeros_like(covariance)
    to_angles[:, :3, :3] = np.eye(3)
    to_angles[:, 3:, 3:] = np.linalg.inv(angle_axes(coordinates[:, 3:]))
    return np.asarray(to_angles @ covariance @ np.swapaxes(to_angles, -1, -2))
