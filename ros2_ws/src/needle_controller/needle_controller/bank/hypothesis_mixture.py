"""A bank of estimates as one: mean pose, covariance, and the table that the roll law reads."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.bank.estimate_tiles import (
    BEHIND_PLAY,
    E_TURN,
    KAPPA,
    KIND,
    LAG,
    LANES,
    NOISE,
    NOISES,
    PLACE,
    PLAY,
    SCALE,
    SHAPE,
    TIP_ANGLE,
    WEIGHT,
    R,
    Tiles,
    X,
    covariances,
    rows,
)
from needle_controller.bank.hypotheses import LASTING
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import angle_axes, rotation_from_angles
from needle_controller.observers.estimator import Estimate
from needle_core.compiled import compiled

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
S_POSITION, S_HEADING, S_SIDE, S_BEND, S_CURVATURE, S_SCALE, S_X_X, S_X_PITCH, S_PITCH_PITCH = (
    0, 3, 6, 9, 10, 11, 12, 13, 14,
)  # fmt: skip
"""A needle's means over its hypotheses: tip, heading, the tip's x axis, s3, curvature, insertion
scale, products of x and sin(pitch)."""
SUMS = 15
L_CURVATURE, L_SCALE, L_NOISE = range(3)
"""What was learned of a needle: curvature [1/m], insertion scale, and the noise as a multiple of
what is claimed, as its likeliest hypothesis has it."""
LEARNED = 3
_AMBIGUOUS_COSINE = math.cos(math.radians(60.0))
_NO_MEAN_ROLL = 0.1


@dataclasses.dataclass(frozen=True)
class Hypotheses:
    """The part of a bank of estimates that a law needs.

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
    tiles: Tiles,
    noises: Array,
    coordinates: Array,
    linearized: Array,
    learned: Array,
    ambiguous: Array,
    table: Array,
    uncertainty: Array,
) -> None:
    """Write the means of every needle's hypotheses.

    Parameters
    ----------
    tiles : Tiles
        The estimates.
    noises : ndarray, shape (3, 3, NOISES)
        As in `take_tip`.
    coordinates : ndarray, shape (N, 6), written
        x, y, z [m] are the weighted mean; the heading is the mean heading, the roll the mean
        direction of the tip's x axis about it, the likeliest one's where those cancel.
    linearized : ndarray, shape (N, 3), written
        Mean of the linearized states (6).
    learned : ndarray, shape (N, LEARNED), written
        What was learned, see `L_CURVATURE`.
    ambiguous : ndarray, shape (N,), written
        Weight of the hypotheses whose roll is more than 60 deg from the likeliest one's.
    table : ndarray, shape (N, K, 8), written
        See `Hypotheses`; likewise `uncertainty`, shape (N, 3).
    """
    sums, going_on = np.empty(SUMS), np.empty_like(tiles.slot)
    for n in range(tiles.first.size - 1):
        sums[:] = 0.0
        whole = heaviest = 0.0
        count = best = 0
        for s in tiles.slot[tiles.first[n] : tiles.first[n + 1]]:
            weight = tiles.state[s // LANES, WEIGHT, s % LANES]
            if weight > 0.0:
                going_on[count] = s
                count += 1
                whole += weight
            if weight > heaviest:
                heaviest, best = weight, s
        slots = going_on[:count]
        for s in slots:
            tile, h = tiles.state[s // LANES], s % LANES
            _add_estimate(tile, h, tile[WEIGHT, h] / whole, sums)
        _fill_table(tiles.state, slots, whole, table[n])
        x, sin_pitch = sums[S_POSITION], sums[S_HEADING]
        linearized[n, 0], linearized[n, 1], linearized[n, 2] = x, sin_pitch, sums[S_BEND]
        learned[n, L_CURVATURE], learned[n, L_SCALE] = sums[S_CURVATURE], sums[S_SCALE]
        learned[n, L_NOISE] = _noise_size(tiles.state[best // LANES], best % LANES, noises)
        uncertainty[n, 0] = sums[S_X_X] - x * x
        uncertainty[n, 1] = sums[S_X_PITCH] - x * sin_pitch
        uncertainty[n, 2] = sums[S_PITCH_PITCH] - sin_pitch * sin_pitch
        ambiguous[n] = _elsewhere(tiles.state, slots, best) / whole
        side = sums[S_SIDE : S_SIDE + 3]
        if side[0] * side[0] + side[1] * side[1] + side[2] * side[2] < _NO_MEAN_ROLL**2:
            for k in range(3):
                side[k] = tiles.state[best // LANES, R + 3 * k, best % LANES]
        for k in range(3):
            coordinates[n, k] = sums[S_POSITION + k]
        _mean_angles(sums[S_HEADING : S_HEADING + 3], side, coordinates[n])


@compiled
def _add_estimate(tile: Array, h: int, weight: float, sums: Array) -> None:
    """Add what an estimate has, by weight."""
    x, rx, ry, rz = tile[X, h], tile[R + 2, h], tile[R + 5, h], tile[R + 8, h]
    for k in range(3):
        sums[S_POSITION + k] += weight * tile[X + k, h]
        sums[S_HEADING + k] += weight * tile[R + 3 * k + 2, h]
        sums[S_SIDE + k] += weight * tile[R + 3 * k, h]
    sums[S_BEND] -= weight * tile[KAPPA, h] * tile[R + 1, h]
    sums[S_CURVATURE] += weight * tile[KAPPA, h]
    sums[S_SCALE] += weight * tile[SCALE, h]
    # A turn w changes the heading's x by w_y heading_z - w_z heading_y.
    y_y, z_y = tile[PLACE[E_TURN + 1, E_TURN + 1], h], tile[PLACE[E_TURN + 2, E_TURN + 1], h]
    z_z = tile[PLACE[E_TURN + 2, E_TURN + 2], h]
    x_pitch = tile[PLACE[E_TURN + 1, 0], h] * rz - tile[PLACE[E_TURN + 2, 0], h] * ry
    pitch_pitch = y_y * rz * rz - 2.0 * z_y * ry * rz + z_z * ry * ry
    sums[S_X_X] += weight * (tile[PLACE[0, 0], h] + x * x)
    sums[S_X_PITCH] += weight * (x_pitch + x * rx)
    sums[S_PITCH_PITCH] += weight * (pitch_pitch + rx * rx)


@compiled
def _noise_size(tile: Array, h: int, noises: Array) -> float:
    """Return the size of the noisiest coordinate."""
    largest = 0.0
    for coordinate in range(3 if tile[SHAPE, h] == LASTING else 1):
        size = 0.0
        for m in range(NOISES):
            share = tile[NOISE + coordinate * NOISES + m, h]
            size += share * noises[int(tile[SHAPE, h]), 0, m]
        largest = max(largest, size)
    return largest


@compiled
def _fill_table(state: Array, slots: npt.NDArray[np.int64], whole: float, table: Array) -> None:
    """Write the means of every torsion hypothesis."""
    table[:] = 0.0
    for s in slots:
        tile, h = state[s // LANES], s % LANES
        weight = tile[WEIGHT, h]
        row = table[int(tile[KIND, h])]
        r00, r01 = tile[R, h], tile[R + 1, h]
        across = weight / math.sqrt(r00 * r00 + r01 * r01)
        row[T_WEIGHT] += weight
        row[T_ROLL] -= across * r01
        row[T_AGREEMENT] += across * r00
        row[T_CURVATURE] += weight * tile[KAPPA, h]
        row[T_TIP_ANGLE] += weight * tile[TIP_ANGLE, h]
        row[T_BEHIND_PLAY] += weight * tile[BEHIND_PLAY, h]
        row[T_PLAY] += weight * tile[PLAY, h]
        row[T_LAG] += weight * tile[LAG, h]
    for k in range(table.shape[0]):
        row = table[k]
        if row[T_WEIGHT] == 0.0:
            continue
        row[:T_WEIGHT] /= row[T_WEIGHT]
        across, along = row[T_ROLL], row[T_AGREEMENT]
        row[T_ROLL] = math.atan2(across, along)
        row[T_AGREEMENT] = math.sqrt(along * along + across * across)
        row[T_WEIGHT] /= whole


@compiled
def _elsewhere(state: Array, slots: npt.NDArray[np.int64], best: int) -> float:
    """Return the weight of hypotheses whose roll is more than 60 deg from one's."""
    top, i = state[best // LANES], best % LANES
    weight = 0.0
    for s in slots:
        tile, h = state[s // LANES], s % LANES
        along = 0.0
        for k in range(3):
            along += top[R + 3 * k, i] * tile[R + 3 * k, h]
        if along < _AMBIGUOUS_COSINE:
            weight += tile[WEIGHT, h]
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


def mixture_covariance(tiles: Tiles, coordinates: Array) -> Array:
    """Return the covariance of the mixture about its mean.

    Parameters
    ----------
    tiles : Tiles
        The estimates.
    coordinates : ndarray, shape (N, 6)
        Their mean, as `mixture` gives it.

    Returns
    -------
    ndarray, shape (N, 6, 6)
        Of x, y, z, yaw, pitch, roll; singular coordinates at pitch +-pi/2.
    """
    owner, firsts = tiles.owner[tiles.slot], tiles.first[:-1]
    weights = rows(tiles, WEIGHT, 1)[:, 0]
    weights = weights / np.add.reduceat(weights, firsts)[owner]
    rotation = rotation_from_angles(coordinates[owner, 3:])
    # The rotation that takes the mean to each one, as a vector.
    difference = rows(tiles, R, 9).reshape(-1, 3, 3) @ np.swapaxes(rotation, -1, -2)
    cosine = 0.5 * (np.trace(difference, axis1=-2, axis2=-1) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    scale = 0.5 / np.maximum(np.sinc(angle / np.pi), 1e-6)
    error = np.empty((len(weights), 6))
    error[:, :3] = rows(tiles, X, 3) - coordinates[owner, :3]
    error[:, 3] = scale * (difference[:, 2, 1] - difference[:, 1, 2])
    error[:, 4] = scale * (difference[:, 0, 2] - difference[:, 2, 0])
    error[:, 5] = scale * (difference[:, 1, 0] - difference[:, 0, 1])
    of_each = covariances(tiles)[:, :6, :6] + error[:, :, None] * error[:, None, :]
    covariance = np.add.reduceat(weights[:, None, None] * of_each, firsts)
    to_angles = np.zeros_like(covariance)
    to_angles[:, :3, :3] = np.eye(3)
    to_angles[:, 3:, 3:] = np.linalg.inv(angle_axes(coordinates[:, 3:]))
    return np.asarray(to_angles @ covariance @ np.swapaxes(to_angles, -1, -2))
