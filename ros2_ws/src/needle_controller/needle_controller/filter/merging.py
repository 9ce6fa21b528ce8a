"""Merging of hypotheses that have become equal; compiled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from needle_controller.filter.motion import rotate
from needle_controller.filter.records import E_KAPPA, E_SCALE, E_TORSION, E_TURN, ERROR, HYPOTHESIS
from needle_controller.model.arrays import Array, Records
from needle_core.compiled import compiled

_SAME_ANGLE = 0.35
"""Largest difference of rolls that count as equal [rad]."""
_SAME_COSINE = math.cos(_SAME_ANGLE)
_SAME_LAG = 0.001
_SAME_GAIN = 0.1
_NUMBERS = HYPOTHESIS.itemsize // 8


@compiled
def copy_hypothesis(source: Records, n: int, target: Records, m: int) -> None:
    """Copy hypothesis n of `source` to place m of `target`."""
    # Copy number by number: assigning a whole record takes seconds to compile.
    of, to = source.view(np.float64), target.view(np.float64)
    for k in range(_NUMBERS):
        to[m * _NUMBERS + k] = of[n * _NUMBERS + k]


@compiled
def remove_weightless(needle: Any, hypotheses: Records) -> None:
    """Remove the hypotheses with weight 0; the others keep their order."""
    count, needle.count = needle.count, 0
    for n in range(count):
        if hypotheses[n].weight > 0.0:
            if needle.count != n:
                copy_hypothesis(hypotheses, n, hypotheses, needle.count)
            needle.count += 1


@compiled
def merge(needle: Any, hypotheses: Records) -> None:
    """Merge equal hypotheses of the same torsion and noise.

    Parameters
    ----------
    needle, hypotheses : NEEDLE, ndarray of HYPOTHESIS, changed
        A needle of a `Bank`, and its hypotheses.
    """
    difference = np.empty(ERROR)
    for first in range(needle.count):
        for second in range(first + 1, needle.count):
            a, b = hypotheses[first], hypotheses[second]
            if a.weight > 0.0 and b.weight > 0.0 and _are_same(a, b):
                _join(a, b, difference)
    remove_weightless(needle, hypotheses)


@compiled
def _are_same(a: Any, b: Any) -> bool:
    """Return whether rolls, pitches and torsion parameters of two hypotheses are close."""
    if a.torsion != b.torsion or a.shape != b.shape:
        return False
    p, q = a.rotation, b.rotation
    along = p[0, 0] * q[0, 0] + p[0, 1] * q[0, 1] + p[0, 2] * q[0, 2]
    return bool(
        along > _SAME_COSINE
        and abs(p[0, 2] - q[0, 2]) < 0.25 * _SAME_ANGLE
        and abs(a.play - b.play) < 0.5 * _SAME_ANGLE
        and abs(a.lag - b.lag) < _SAME_LAG
        and abs(a.gain - b.gain) < _SAME_GAIN
        # If the positions differ, one of them has jumped.
        and (a.position[0] - b.position[0]) ** 2 < max(a.covariance[0, 0], b.covariance[0, 0])
    )


@compiled
def _join(a: Any, b: Any, difference: Array) -> None:
    """Replace the first by the mean and covariance of both; set the weight of the second to 0.

    With s the share of b and d = b - a: mean a + s d, P = (1 - s) P_a + s P_b + s (1 - s) d d^T.
    """
    weight = a.weight + b.weight
    s = b.weight / weight
    for k in range(3):
        difference[k] = b.position[k] - a.position[k]
        # R_b R_a^T, a small rotation, as a vector.
        left, right, turn = (k + 1) % 3, (k + 2) % 3, 0.0
        for m in range(3):
            turn += b.rotation[right, m] * a.rotation[left, m]
            turn -= b.rotation[left, m] * a.rotation[right, m]
        difference[E_TURN + k] = 0.5 * turn
    difference[E_KAPPA] = b.curvature - a.curvature
    difference[E_TORSION] = b.play - a.play + b.lag - a.lag + b.gain - a.gain
    difference[E_SCALE] = b.scale - a.scale
    for k in range(ERROR):
        for m in range(ERROR):
            apart = (1.0 - s) * difference[k] * difference[m]
            a.covariance[k, m] += s * (b.covariance[k, m] - a.covariance[k, m] + apart)
    rotate(a.rotation, s * difference[3], s * difference[4], s * difference[5])
    a.curvature += s * (b.curvature - a.curvature)
    a.scale += s * (b.scale - a.scale)
    a.play += s * (b.play - a.play)
    a.lag += s * (b.lag - a.lag)
    a.gain += s * (b.gain - a.gain)
    a.tip_angle += s * (b.tip_angle - a.tip_angle)
    a.behind_play += s * (b.behind_play - a.behind_play)
    a.dtip_dtorsion += s * (b.dtip_dtorsion - a.dtip_dtorsion)
    for k in range(3):
        a.position[k] += s * difference[k]
        a.residual[k] += s * (b.residual[k] - a.residual[k])
        for m in range(a.noise_weights.shape[1]):
            a.noise_weights[k, m] += s * (b.noise_weights[k, m] - a.noise_weights[k, m])
    a.weight, b.weight = weight, 0.0
