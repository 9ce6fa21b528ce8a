"""Update of a hypothesis by a measured heading ([KC09] V); compiled.

A sensor with five or six degrees of freedom measures the direction of the tip, but not the roll
about it. Like a tip, a heading may be an outlier.
"""

from __future__ import annotations

import math
from typing import Any

from needle_controller.filter.records import E_TURN, ERROR
from needle_controller.filter.tip_update import (
    DENSITY,
    OUTLIER_DENSITY,
    Workspace,
    apply_change,
    reduce_covariance,
)
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled


@compiled
def update_by_heading(h: Any, heading: Array, assumed: Any, work: Workspace) -> float:
    """Update a hypothesis by a heading; return its likelihood, relative to the claimed noise.

    With d the estimated heading and m the measured one, the true one is exp(w) d to first order in
    the rotation error w. v is the rotation across d from d to m; along the tip's axes x and y,

        v x = w x + noise, v y = w y + noise.

    Parameters
    ----------
    h : HYPOTHESIS, changed
        The hypothesis.
    heading : ndarray, shape (4,)
        Unit vector, and the variance of its angle in each direction [rad^2].
    assumed : ASSUMPTIONS
        Limits of the estimates, and share of outliers.
    work : Workspace
        Working memory.
    """
    p, r, c, change = h.covariance, h.rotation, work.cross_covariance, work.change
    variance, likelihood, spread = heading[3], 1.0, OUTLIER_DENSITY ** (2.0 / 3.0)
    work.change[:], work.reduction[:], c[:] = 0.0, 0.0, 0.0
    # m in the axes of the tip: v = angle (d x m) / |d x m|, its components along x and y
    x = r[0, 0] * heading[0] + r[1, 0] * heading[1] + r[2, 0] * heading[2]
    y = r[0, 1] * heading[0] + r[1, 1] * heading[1] + r[2, 1] * heading[2]
    z = r[0, 2] * heading[0] + r[1, 2] * heading[1] + r[2, 2] * heading[2]
    sine = math.sqrt(x * x + y * y)
    stretch = math.atan2(sine, z) / sine if sine > 0.0 else 1.0
    for i in range(2):
        # c = P H^T, less the reduction by the previous axis
        by = r[0, i] * c[0, E_TURN] + r[1, i] * c[0, E_TURN + 1] + r[2, i] * c[0, E_TURN + 2]
        for k in range(ERROR):
            c[i, k] = -work.reduction[0] * by * c[0, k]
            for j in range(3):
                c[i, k] += r[j, i] * p[k, E_TURN + j]
        # nu = v - H e, S = H P H^T + R
        innovation, total = (x if i == 1 else -y) * stretch, variance
        for j in range(3):
            innovation -= r[j, i] * change[E_TURN + j]
            total += r[j, i] * c[i, E_TURN + j]
        # e <- e + c nu / S, P <- P - c c^T / S
        work.reduction[i] = 1.0 / total
        for k in range(ERROR):
            change[k] += c[i, k] * innovation / total
        share = math.sqrt(variance / total)
        spread *= share
        likelihood *= math.sqrt(12.0) * DENSITY * share * math.exp(-0.5 * innovation**2 / total)
    outlier = assumed.outlier_share * spread
    evidence = outlier + (1.0 - assumed.outlier_share) * likelihood
    reduce_covariance(p, outlier / evidence, work)
    apply_change(h, outlier / evidence, assumed, work)
    return float(evidence)
