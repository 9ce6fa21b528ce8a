"""Prediction of a hypothesis and its covariance by one insertion on SE(3); compiled.

The shaft's torsion is modelled as play, then a lag in inserted length. [KC09] neglects torsion and
names friction along the shaft as the likely cause of its "sluggish response". Play D: the shaft's
angle is constant until the base is D ahead, then follows at that distance. Lag L: the tip follows
the shaft over the inserted length, d(tip)/dl = (behind - tip) / L.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Any

from needle_controller.filter.filter_settings import GAIN
from needle_controller.filter.records import E_KAPPA, E_SCALE, E_TORSION, E_TURN, ERROR
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

LARGEST_TURN = 1.0
"""Largest rotation of the base in one advance [rad]; larger ones must be divided."""
_SHORT_RAMP = 1e-3
_LARGEST_ROTATION = 1.5


@compiled
def rotation_factors(squared: float) -> tuple[float, float, float]:
    """Return Rodrigues' factors sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 for a^2.

    The series have relative errors up to 5e-8 for a <= 2.
    """
    q = squared
    first = 1.0 - q / 72.0 * (1.0 - q / 110.0 * (1.0 - q / 156.0))
    first = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * first))
    second = 1.0 - q / 90.0 * (1.0 - q / 132.0 * (1.0 - q / 182.0))
    second = 0.5 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * second)))
    third = 1.0 - q / 110.0 * (1.0 - q / 156.0 * (1.0 - q / 210.0))
    third = (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0 * third))) / 6.0
    return first, second, third


@compiled
def turn_tip(
    tip: float,
    behind_play: float,
    per_size: float,
    base: float,
    turn: float,
    length: float,
    play: float,
    lag_length: float,
) -> tuple[float, float, float]:
    """Return the tip's rotation after the base has turned evenly over a length.

    Parameters
    ----------
    tip, behind_play : float
        Initial angles of the tip and of the shaft behind the play [rad].
    per_size : float
        Initial derivative of `tip` with respect to the torsion parameter: the lag length if there
        is one [rad/m], otherwise the play [-].
    base, turn : float
        Initial angle of the base, and its change [rad].
    length : float
        Inserted length [m].
    play : float
        Half width of the dead band D [rad].
    lag_length : float
        L [m]; 0 for no lag.

    Returns
    -------
    tip, behind_play, per_size : float
        Final values.
    """
    # |base - behind| <= D
    after = base + turn
    behind = min(max(behind_play, after - play), after + play)
    change = behind - behind_play
    if lag_length == 0.0:
        # The tip is at the edge of the play: base -+ D.
        if change > 0.0:
            per_size = -1.0
        elif change < 0.0:
            per_size = 1.0
        return behind, behind, per_size
    if length <= 0.0:
        # Without insertion, the tip does not follow.
        return tip, behind, per_size
    # The play closes first; the subsequent ramp takes the rest of the length, q lags.
    share = min(max(change / turn, 0.0), 1.0) if turn != 0.0 else 1.0
    decay, q = math.exp(-length / lag_length), length * share / lag_length
    if q < _SHORT_RAMP:
        part, slope = 0.5 * q, -0.5 * q
    else:
        part = 1.0 + math.expm1(-q) / q
        slope = (math.exp(-q) * (1.0 + q) - 1.0) / q
    # tip(l) = behind_0 + (tip_0 - behind_0) exp(-l/L) + change (1 - (1 - exp(-q)) / q)
    distance = tip - behind_play
    by_lag = (per_size + distance * length / lag_length**2) * decay + change * slope / lag_length
    return behind_play + distance * decay + change * part, behind, by_lag


@compiled
def advance_hypothesis(
    h: Any, base: float, turn: float, length: float, assumed: Any, gain: Array
) -> None:
    """Predict a hypothesis and its covariance by a motion of the base: P <- F P F^T + Q.

    The pose is exact; its derivative with respect to the curvature is correct up to (kappa
    length)^2.

    Parameters
    ----------
    h : HYPOTHESIS, changed
        The hypothesis.
    base, turn : float
        Initial angle of the base, and its change [rad], at most `LARGEST_TURN`.
    length : float
        Inserted length l [m].
    assumed : ASSUMPTIONS
        Process noise.
    gain : ndarray, shape (6, 6)
        Working memory.
    """
    angles = h.tip_angle, h.behind_play, h.dtip_dtorsion
    follows, turns = h.gain * base, h.gain * turn
    tip, behind, dtip_dtorsion = turn_tip(*angles, follows, turns, length, h.play, h.lag)
    if h.torsion_kind == GAIN:
        dtip_dtorsion = base + turn
    theta, torsion_change = tip - h.tip_angle, dtip_dtorsion - h.dtip_dtorsion
    h.tip_angle, h.behind_play, h.dtip_dtorsion = tip, behind, dtip_dtorsion
    # T <- T exp((V1 s l + V2 theta)^), (2): in its own axes the tip turns by (kappa s l, 0, theta).
    advanced = h.scale * length
    x, z = h.curvature * advanced, theta
    a, b, c = rotation_factors(x * x + z * z)
    kappa_per_scale = h.curvature / h.scale
    for i in range(3):
        r0, r1, r2 = h.rotation[i, 0], h.rotation[i, 1], h.rotation[i, 2]
        # Mean heading m over the motion: p <- p + s l m.
        heading = c * x * z * r0 - b * x * r1 + (1.0 - c * x * x) * r2
        h.position[i] += advanced * heading
        # R <- R exp((x, 0, z)^) = R (I + a (.)^ + b (.)^ (.)^)
        h.rotation[i, 0] = (1.0 - b * z * z) * r0 + a * z * r1 + b * x * z * r2
        h.rotation[i, 1] = (1.0 - b * (x * x + z * z)) * r1 - a * z * r0 + a * x * r2
        h.rotation[i, 2] = (1.0 - b * x * x) * r2 + b * x * z * r0 - a * x * r1
        # dp / dkappa and dR / dkappa (a rotation vector)
        shift = advanced * advanced * (c * z * r0 - b * r1 - 2.0 * c * x * r2)
        bend = advanced * ((1.0 - c * z * z) * r0 + b * z * r1 + c * x * z * r2)
        # dp = w x (s l m) + shift dkappa + (l m + kappa / s shift) ds
        gain[(i + 1) % 3, (i + 2) % 3] = advanced * heading
        gain[(i + 2) % 3, (i + 1) % 3] = -advanced * heading
        gain[i, i] = gain[i, E_TORSION - E_TURN] = 0.0
        gain[i, E_KAPPA - E_TURN] = shift
        gain[i, E_SCALE - E_TURN] = length * heading + kappa_per_scale * shift
        # dw = bend dkappa + m dtheta + kappa / s bend ds
        gain[3 + i, E_KAPPA - E_TURN] = bend
        gain[3 + i, E_TORSION - E_TURN] = torsion_change * heading
        gain[3 + i, E_SCALE - E_TURN] = kappa_per_scale * bend
    p = h.covariance
    propagate(p, gain)
    # about the heading z: Q = heading_drift I + (roll_drift - heading_drift) z z^T
    for i in range(3):
        p[E_TURN + i, E_TURN + i] += h.heading_drift * length
        along = (h.roll_drift - h.heading_drift) * h.rotation[i, 2] * length
        for j in range(3):
            p[E_TURN + i, E_TURN + j] += along * h.rotation[j, 2]
    p[E_KAPPA, E_KAPPA] += assumed.curvature_drift * length
    p[E_SCALE, E_SCALE] += assumed.scale_drift * length
    if p[E_TORSION, E_TORSION] > 0.0:
        p[E_TORSION, E_TORSION] += assumed.torsion_drift[h.torsion_kind] * length


@compiled
def propagate(p: Array, gain: Array) -> None:
    """Propagate a covariance over a step: P <- F P F^T.

    Parameters
    ----------
    p : ndarray, shape (9, 9), changed
        Covariance of the error e.
    gain : ndarray, shape (6, 6)
        Effect of the other elements of the error on position and orientation: F = I + (0 gain;
        0 0). The first three columns of the lower half are not read: they would be 0.
    """
    # F P changes the first six rows.
    for i in range(6):
        for j in range(0 if i < 3 else 3, 6):
            g = gain[i, j]
            for k in range(ERROR):
                p[i, k] += g * p[3 + j, k]
    # (F P) F^T changes the columns; the upper triangle is copied from the lower one.
    for k in range(ERROR):
        for i in range(min(k + 1, 6)):
            total = p[k, i]
            for j in range(0 if i < 3 else 3, 6):
                total += gain[i, j] * p[k, 3 + j]
            p[k, i] = total
    for k in range(ERROR):
        for i in range(k):
            p[i, k] = p[k, i]


@compiled
def rotate(rotation: Array, x: float, y: float, z: float) -> None:
    """Rotate an orientation by a vector in `target_plane`, at most 1.5 rad: R <- exp(v^) R."""
    squared = x * x + y * y + z * z
    if squared > _LARGEST_ROTATION**2:
        scale = _LARGEST_ROTATION / squared**0.5
        x, y, z, squared = scale * x, scale * y, scale * z, _LARGEST_ROTATION**2
    a, b, _ = rotation_factors(squared)
    for k in range(3):
        r0, r1, r2 = rotation[0, k], rotation[1, k], rotation[2, k]
        # exp(v^) r = r + a v x r + b v x (v x r), where v x (v x r) = v (v r) - r v^2
        along = x * r0 + y * r1 + z * r2
        rotation[0, k] = r0 + a * (y * r2 - z * r1) + b * (x * along - squared * r0)
        rotation[1, k] = r1 + a * (z * r0 - x * r2) + b * (y * along - squared * r1)
        rotation[2, k] = r2 + a * (x * r1 - y * r0) + b * (z * along - squared * r2)
