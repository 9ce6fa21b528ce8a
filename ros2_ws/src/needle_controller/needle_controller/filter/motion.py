"""One insertion on SE(3), and what it does to a hypothesis and its covariance; compiled."""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

from typing import Any

from needle_controller.filter.hypotheses import GAIN
from needle_controller.filter.records import (
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    ERROR,
)
from needle_controller.filter.torsion import turn_tip
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

LARGEST_TURN = 1.0
"""Most that an advance may turn the base at once [rad]; larger ones are to be divided."""
_LARGEST_ROTATION = 1.5


@compiled
def rotation_factors(squared: float) -> tuple[float, float, float]:
    """Return sin(a)/a, (1 - cos(a))/a^2, (a - sin(a))/a^3 of a^2: Rodrigues' formula's factors.

    Series, right to 5e-8 of themselves up to a = 2.
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
def advance_hypothesis(
    h: Any, base: float, turn: float, length: float, known: Any, gain: Array
) -> None:
    """Move a hypothesis by what the base did, and its covariance: P <- F P F^T + Q.

    The pose moves exactly; how it depends on the curvature is right up to (kappa length)^2.

    Parameters
    ----------
    h : HYPOTHESIS, changed
        The hypothesis.
    base, turn : float
        Angle of the base before, and how far it turns [rad], at most `LARGEST_TURN`.
    length : float
        Inserted length l [m].
    known : ASSUMPTIONS
        What grows uncertain on the way.
    gain : ndarray, shape (6, 6)
        Working memory.
    """
    angles = h.tip_angle, h.behind_play, h.dtip_dsize
    follows, turns = h.gain * base, h.gain * turn
    tip, behind, dtip_dsize = turn_tip(*angles, follows, turns, length, h.play, h.lag)
    if h.sized == GAIN:
        dtip_dsize = base + turn
    theta, size_change = tip - h.tip_angle, dtip_dsize - h.dtip_dsize
    h.tip_angle, h.behind_play, h.dtip_dsize = tip, behind, dtip_dsize
    # T <- T exp((V1 s l + V2 theta)^), (2): in its own axes the tip turns by (kappa s l, 0, theta).
    gone = h.scale * length
    x, z = h.curvature * gone, theta
    a, b, c = rotation_factors(x * x + z * z)
    kappa_per_scale = h.curvature / h.scale
    for i in range(3):
        r0, r1, r2 = h.rotation[i, 0], h.rotation[i, 1], h.rotation[i, 2]
        # Mean heading m over the way: p <- p + s l m.
        heading = c * x * z * r0 - b * x * r1 + (1.0 - c * x * x) * r2
        h.position[i] += gone * heading
        # R <- R exp((x, 0, z)^) = R (I + a (.)^ + b (.)^ (.)^)
        h.rotation[i, 0] = (1.0 - b * z * z) * r0 + a * z * r1 + b * x * z * r2
        h.rotation[i, 1] = (1.0 - b * (x * x + z * z)) * r1 - a * z * r0 + a * x * r2
        h.rotation[i, 2] = (1.0 - b * x * x) * r2 + b * x * z * r0 - a * x * r1
        # dp / dkappa and dR / dkappa (a rotation vector)
        shift = gone * gone * (c * z * r0 - b * r1 - 2.0 * c * x * r2)
        bend = gone * ((1.0 - c * z * z) * r0 + b * z * r1 + c * x * z * r2)
        # dp = w x (s l m) + shift dkappa + (l m + kappa / s shift) ds
        gain[(i + 1) % 3, (i + 2) % 3] = gone * heading
        gain[(i + 2) % 3, (i + 1) % 3] = -gone * heading
        gain[i, i] = gain[i, E_SIZE - E_TURN] = 0.0
        gain[i, E_KAPPA - E_TURN] = shift
        gain[i, E_SCALE - E_TURN] = length * heading + kappa_per_scale * shift
        # dw = bend dkappa + m dtheta + kappa / s bend ds
        gain[3 + i, E_KAPPA - E_TURN] = bend
        gain[3 + i, E_SIZE - E_TURN] = size_change * heading
        gain[3 + i, E_SCALE - E_TURN] = kappa_per_scale * bend
    p = h.covariance
    propagate(p, gain)
    # about the heading z: Q = heading_drift I + (roll_drift - heading_drift) z z^T
    for i in range(3):
        p[E_TURN + i, E_TURN + i] += h.heading_drift * length
        along = (h.roll_drift - h.heading_drift) * h.rotation[i, 2] * length
        for j in range(3):
            p[E_TURN + i, E_TURN + j] += along * h.rotation[j, 2]
    p[E_KAPPA, E_KAPPA] += known.curvature_drift * length
    p[E_SCALE, E_SCALE] += known.scale_drift * length
    if p[E_SIZE, E_SIZE] > 0.0:
        p[E_SIZE, E_SIZE] += known.size_drift[h.sized] * length


@compiled
def propagate(p: Array, gain: Array) -> None:
    """Carry a covariance over a step: P <- F P F^T.

    Parameters
    ----------
    p : ndarray, shape (9, 9), changed
        Covariance of the error e.
    gain : ndarray, shape (6, 6)
        What position and orientation gain of the error's other elements: F = I + (0 gain; 0 0). In
        the lower half the first three columns are not read: no orientation gains of another.
    """
    # F P: the first rows gain of the others.
    for i in range(6):
        for j in range(0 if i < 3 else 3, 6):
            g = gain[i, j]
            for k in range(ERROR):
                p[i, k] += g * p[3 + j, k]
    # (F P) F^T: likewise the columns; what is above the diagonal is what is below it.
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
    """Turn an orientation by a vector in `target_plane`, 1.5 rad at most: R <- exp(v^) R."""
    squared = x * x + y * y + z * z
    if squared > _LARGEST_ROTATION**2:
        scale = _LARGEST_ROTATION / squared**0.5
        x, y, z, squared = scale * x, scale * y, scale * z, _LARGEST_ROTATION**2
    a, b, _ = rotation_factors(squared)
    for k in range(3):
        r0, r1, r2 = rotation[0, k], rotation[1, k], rotation[2, k]
        # exp(v^) r = r + a v x r + b v x (v x r), the last of which is v (v r) - r v^2
        along = x * r0 + y * r1 + z * r2
        rotation[0, k] = r0 + a * (y * r2 - z * r1) + b * (x * along - squared * r0)
        rotation[1, k] = r1 + a * (z * r0 - x * r2) + b * (y * along - squared * r1)
        rotation[2, k] = r2 + a * (x * r1 - y * r0) + b * (z * along - squared * r2)
