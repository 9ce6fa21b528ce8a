"""Combination of all hypotheses of a needle into one estimate; compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from needle_controller.filter.bank import predicted_hypotheses
from needle_controller.filter.filter_settings import CORRELATED, NORMAL
from needle_controller.filter.records import E_TURN, NEAR, NOISES, Bank
from needle_controller.filter.tip_update import SMALLEST_VARIANCE
from needle_controller.model.arrays import Array, Records
from needle_controller.model.kinematics import angle_axes
from needle_controller.observers.estimator import Estimate, Hypotheses
from needle_core.compiled import compiled

HIDDEN_SHARE = 0.5
"""Assumed systematic part of a claimed variance that the tips do not reveal."""
_AMBIGUOUS_COSINE = math.cos(math.radians(60.0))
_NO_MEAN_ROLL = 0.1


@compiled
def estimate_needle(bank: Bank, n: int) -> None:
    """Compute the estimate of needle n.

    Position and heading are weighted means; the roll is the mean direction of the tip's x axis
    about the heading, or that of the likeliest hypothesis if the directions cancel.
    """
    needle, estimate, assumed = bank.needles[n], bank.estimates[n], bank.assumed[0]
    every = predicted_hypotheses(needle, bank.hypotheses[n], assumed)
    whole, best = 0.0, 0
    for m in range(needle.count):
        whole += every[m].weight
        if every[m].weight > every[best].weight:
            best = m
    position, heading, side = np.zeros(3), np.zeros(3), np.zeros(3)
    bend = curvature = scale = xx = x_pitch = pitch_pitch = ambiguous = miss = 0.0
    for m in range(needle.count):
        h = every[m]
        w, r, p = h.weight / whole, h.rotation, h.covariance
        along = 0.0
        for k in range(3):
            position[k] += w * h.position[k]
            heading[k] += w * r[k, 2]
            side[k] += w * r[k, 0]
            along += every[best].rotation[k, 0] * r[k, 0]
        ambiguous += w if along < _AMBIGUOUS_COSINE else 0.0
        # s3 = kappa cos(pitch) sin(roll) = -kappa R_01, (6)
        bend -= w * h.curvature * r[0, 1]
        curvature += w * h.curvature
        scale += w * h.scale
        # A rotation w changes sin(pitch), the heading's x, by w_y heading_z - w_z heading_y.
        x, y_y, z_z = h.position[0], p[E_TURN + 1, E_TURN + 1], p[E_TURN + 2, E_TURN + 2]
        x_x = p[0, 0] + assumed.model_error + _hidden_share(h, assumed) * needle.claimed[0]
        xx += w * (x_x + x * x)
        miss += w * exceedance_probability(x, x_x)
        of_both = p[0, E_TURN + 1] * r[2, 2] - p[0, E_TURN + 2] * r[1, 2]
        x_pitch += w * (of_both + x * r[0, 2])
        variance = y_y * r[2, 2] ** 2 + z_z * r[1, 2] ** 2
        variance -= 2.0 * p[E_TURN + 1, E_TURN + 2] * r[1, 2] * r[2, 2]
        pitch_pitch += w * (variance + r[0, 2] ** 2)
    if side[0] ** 2 + side[1] ** 2 + side[2] ** 2 < _NO_MEAN_ROLL**2:
        for k in range(3):
            side[k] = every[best].rotation[k, 0]
    for k in range(3):
        estimate.coordinates[k] = position[k]
    _write_angles(heading, side, estimate.coordinates)
    estimate.linearized[0], estimate.linearized[1], estimate.linearized[2] = (
        position[0],
        heading[0],
        bend,
    )
    estimate.uncertainty[0] = xx - position[0] * position[0]
    estimate.uncertainty[1] = x_pitch - position[0] * heading[0]
    estimate.uncertainty[2] = pitch_pitch - heading[0] * heading[0]
    estimate.curvature, estimate.scale, estimate.ambiguous = curvature, scale, ambiguous
    estimate.noise = _noise_size(every[best], assumed.noises)
    estimate.base = needle.base
    for k in range(needle.pending):
        estimate.base += needle.pending_turn[k]
    estimate.wound = estimate.base + needle.start_turn
    estimate.miss = miss
    _average_torsions(every, whole, bank.torsions[n])
    _write_covariance(needle, every, whole, estimate, assumed)


@compiled
def _hidden_share(h: Any, assumed: Any) -> float:
    """Return the share of the claimed variance that may be an error common to all tips.

    Like the error of the model, it does not average out.
    """
    unseen = 0.0
    if h.shape == NORMAL:
        for m in range(NOISES):
            share = 1.0 - assumed.noises[NORMAL, 0, m] ** 2
            unseen += h.noise_weights[0, m] * max(share, 0.0)
    return HIDDEN_SHARE * unseen


@compiled
def exceedance_probability(x: float, variance: float) -> float:
    """Return the probability that a normal variable is farther from 0 than `NEAR`."""
    per_sqrt_2 = 1.0 / math.sqrt(2.0 * max(variance, SMALLEST_VARIANCE))
    return 0.5 * (math.erfc((NEAR - x) * per_sqrt_2) + math.erfc((NEAR + x) * per_sqrt_2))


@compiled
def _write_angles(axis: Array, side: Array, coordinates: Array) -> None:
    """Compute yaw, pitch and roll from a mean heading and a mean x axis of the tip."""
    norm = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    x, y, z = axis[0] / norm, axis[1] / norm, axis[2] / norm
    along = side[0] * x + side[1] * y + side[2] * z
    side_x, side_y, side_z = side[0] - along * x, side[1] - along * y, side[2] - along * z
    coordinates[3] = math.atan2(-y, z)
    coordinates[4] = math.asin(min(max(x, -1.0), 1.0))
    # R's first row is (cos(pitch) cos(roll), -cos(pitch) sin(roll), sin(pitch)).
    coordinates[5] = math.atan2(-(y * side_z - z * side_y), side_x)


@compiled
def _noise_size(h: Any, noises: Array) -> float:
    """Return the noise of the noisiest coordinate, relative to the claimed one."""
    largest = 0.0
    for i in range(3 if h.shape == CORRELATED else 1):
        size = 0.0
        for m in range(NOISES):
            size += h.noise_weights[i, m] * noises[h.shape, 0, m]
        largest = max(largest, size)
    return largest


@compiled
def _average_torsions(every: Records, whole: float, torsions: Records) -> None:
    """Compute the mean over the hypotheses of each torsion."""
    for k in range(torsions.size):
        t = torsions[k]
        across = along = 0.0
        t.roll = t.agreement = t.curvature = t.tip_angle = t.behind_play = 0.0
        t.play = t.lag = t.gain = t.weight = 0.0
        for n in range(every.size):
            h = every[n]
            if h.torsion != k:
                continue
            # (cos(roll), sin(roll)) = (R_00, -R_01) / cos(pitch)
            cosine, sine = h.rotation[0, 0], -h.rotation[0, 1]
            unit = h.weight / math.sqrt(cosine * cosine + sine * sine)
            along += unit * cosine
            across += unit * sine
            t.weight += h.weight
            t.curvature += h.weight * h.curvature
            t.tip_angle += h.weight * h.tip_angle
            t.behind_play += h.weight * h.behind_play
            t.play += h.weight * h.play
            t.lag += h.weight * h.lag
            t.gain += h.weight * h.gain
        if t.weight == 0.0:
            continue
        t.roll = math.atan2(across, along)
        t.agreement = math.sqrt(along * along + across * across) / t.weight
        t.curvature /= t.weight
        t.tip_angle /= t.weight
        t.behind_play /= t.weight
        t.play /= t.weight
        t.lag /= t.weight
        t.gain /= t.weight
        t.weight /= whole


@compiled
def _write_covariance(
    needle: Any, every: Records, whole: float, estimate: Any, assumed: Any
) -> None:
    """Compute the covariance of the mixture for position and rotation vector."""
    q, error = estimate.coordinates, np.empty(6)
    ca, sa, cb, sb = math.cos(q[3]), math.sin(q[3]), math.cos(q[4]), math.sin(q[4])
    cg, sg = math.cos(q[5]), math.sin(q[5])
    # R = Rx(yaw) Ry(pitch) Rz(roll)
    mean = np.empty((3, 3))
    mean[0, 0], mean[0, 1], mean[0, 2] = cb * cg, -cb * sg, sb
    mean[1, 0], mean[1, 1], mean[1, 2] = ca * sg + sa * sb * cg, ca * cg - sa * sb * sg, -sa * cb
    mean[2, 0], mean[2, 1], mean[2, 2] = sa * sg - ca * sb * cg, sa * cg + ca * sb * sg, ca * cb
    estimate.covariance[:] = 0.0
    for n in range(every.size):
        h = every[n]
        # The rotation vector of D = R_n R^T is (D - D^T) / 2 times angle / sin(angle).
        trace = 0.0
        for i in range(3):
            left, right, turn = (i + 1) % 3, (i + 2) % 3, 0.0
            for m in range(3):
                turn += h.rotation[right, m] * mean[left, m] - h.rotation[left, m] * mean[right, m]
                trace += h.rotation[i, m] * mean[i, m]
            error[i], error[3 + i] = h.position[i] - q[i], 0.5 * turn
        angle = math.acos(min(max(0.5 * (trace - 1.0), -1.0), 1.0))
        stretch = angle / max(math.sin(angle), 1e-6) if angle > 1e-6 else 1.0
        for i in range(3):
            error[3 + i] *= stretch
        for i in range(6):
            for j in range(6):
                spread = h.covariance[i, j] + error[i] * error[j]
                estimate.covariance[i, j] += h.weight / whole * spread
        hidden = _hidden_share(h, assumed)
        for i in range(3):
            common = assumed.model_error + hidden * needle.claimed[i]
            estimate.covariance[i, i] += h.weight / whole * common


def estimate_from_record(
    record: np.void, torsions: Records, warnings: tuple[str, ...] = ()
) -> Estimate:
    """Return the `Estimate` of a record, an ESTIMATE with its TORSION, shape (K,)."""
    # A change of the angles turns the tip by axes @ change.
    to_angles = np.eye(6)
    to_angles[3:, 3:] = np.linalg.inv(angle_axes(record["coordinates"][3:]))
    return Estimate(
        coordinates=record["coordinates"],
        linearized=record["linearized"],
        curvature=float(record["curvature"]),
        covariance=to_angles @ record["covariance"] @ to_angles.T,
        warnings=warnings,
        miss=float(record["miss"]),
        hypotheses=Hypotheses(record, torsions),
    )
