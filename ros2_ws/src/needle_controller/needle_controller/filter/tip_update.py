"""Update of a hypothesis by one measured tip with unknown noise; compiled.

Several noise models are possible, each uniform within a bound or normal; the tip may also be an
outlier, which carries no information. With uniform noise the tip lies in a box around the
measurement, so the posterior of a Gaussian prior is that Gaussian truncated to the box. For one
coordinate after the other, the mixture over the models is replaced by the Gaussian of the same mean
and variance (assumed-density filtering; truncated normals have these in closed form). The final
estimate is the mixture of the updated and the old one, weighted by the probability of an outlier. A
tip with a correlated covariance is split along directions in which its errors are independent.

If errors are correlated from tip to tip, e' = c e + sqrt(1 - c^2) w with w of variance R, the
innovation less c times the residual of the previous tip is

    d' - c d + sqrt(1 - c^2) w

where d and d' are the errors of the estimate at both tips. Part of the variance of d', at most R,
already existed at the previous tip, because no estimate is less certain than its tip; the rest is
new.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.filter.filter_settings import CORRELATED, GAIN, LAG, UNIFORM
from needle_controller.filter.motion import rotate
from needle_controller.filter.records import E_KAPPA, E_SCALE, E_TORSION, E_TURN, ERROR, NOISES
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

SMALLEST_VARIANCE = 1e-18
"""Smallest variance of a measured coordinate [m^2], which avoids a division by 0."""
_SMALLEST_SHARE = 0.02
_SMALLEST_GAIN, _LARGEST_GAIN = 0.3, 1.5
_LARGEST_PLAY = 1.0
_SMALLEST_LAG, _LARGEST_LAG = 0.001, 0.016
OUTLIER_DENSITY = 4.0**-3
"""Outliers are spread over four times the claimed bound (sqrt(3) standard deviations)."""
_NO_MASS = 1e-30
_DROPPED_SHARE = 1e-3
_RESTORED_SHARE = 0.2
_FAR = 5.5
DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
"""Density of a standard normal variable at 0."""


class Reading(NamedTuple):
    """A tip, and its components along directions in which its errors are independent."""

    tip: Array  # shape (3,) [m]
    covariance: Array  # (3, 3) [m^2]
    heading: Array  # (4,): measured heading, and its variance [rad^2]; 0: not measured
    directions: Array  # rows, (3, 3): those of L^-1, covariance = L D L^T
    values: Array  # components of the tip, (3,) [m]
    bounds: Array  # claimed bounds, (3,): sqrt(3) standard deviations [m]


class Workspace(NamedTuple):
    """Working memory of an update."""

    cross_covariance: Array  # of each coordinate with the error, (3, 9)
    reduction: Array  # of the covariance by each coordinate, (3,)
    change: Array  # of the mean of the error, (9,)
    shares: Array  # probability of each noise model by each coordinate, (3, NOISES)
    possible: npt.NDArray[np.int64]  # numbers of the noise models with a probability > 0


@compiled
def new_workspace() -> Workspace:
    """Return uninitialized working memory."""
    return Workspace(
        np.empty((3, ERROR)),
        np.empty(3),
        np.empty(ERROR),
        np.empty((3, NOISES)),
        np.empty(NOISES, dtype=np.int64),
    )


@compiled
def new_reading(tip: Array, covariance: Array, heading: Array) -> Reading:
    """Return a reading whose components `prepare_reading` computes."""
    return Reading(tip, covariance, heading, np.empty((3, 3)), np.empty(3), np.empty(3))


@compiled
def prepare_reading(reading: Reading) -> bool:
    """Compute directions, values and bounds; return whether tip and covariance are finite."""
    tip, covariance = reading.tip, reading.covariance
    if not math.isfinite(tip.sum() + covariance.sum()):
        return False
    d0 = max(covariance[0, 0], SMALLEST_VARIANCE)
    l10, l20 = covariance[1, 0] / d0, covariance[2, 0] / d0
    d1 = max(covariance[1, 1] - l10 * l10 * d0, SMALLEST_VARIANCE)
    l21 = (covariance[2, 1] - l20 * l10 * d0) / d1
    d2 = max(covariance[2, 2] - l20 * l20 * d0 - l21 * l21 * d1, SMALLEST_VARIANCE)
    reading.directions[:] = 0.0
    for i in range(3):
        reading.directions[i, i] = 1.0
    reading.directions[1, 0] = -l10
    reading.directions[2, 0], reading.directions[2, 1] = l21 * l10 - l20, -l21
    y = tip[1] - l10 * tip[0]
    reading.values[0], reading.values[1] = tip[0], y
    reading.values[2] = tip[2] - l21 * y - l20 * tip[0]
    reading.bounds[0], reading.bounds[1] = math.sqrt(3.0 * d0), math.sqrt(3.0 * d1)
    reading.bounds[2] = math.sqrt(3.0 * d2)
    return True


@compiled
def update_hypothesis(h: Any, reading: Reading, assumed: Any, work: Workspace) -> None:
    """Update a hypothesis by a tip.

    Parameters
    ----------
    h : HYPOTHESIS, changed
        The hypothesis. `evidence` becomes the tip's likelihood, relative to noise within the
        claimed bounds, and `outlier` the probability of an outlier.
    reading : Reading
        The tip, after `prepare_reading`.
    assumed : ASSUMPTIONS
        Limits of the estimates, noise models, and share of outliers.
    work : Workspace
        Working memory.
    """
    work.change[:] = 0.0
    for i in range(3):
        for m in range(NOISES):
            work.shares[i, m] = h.noise_weights[i, m]
    likelihood, spread = 1.0, OUTLIER_DENSITY
    for i in range(3):
        innovation, variance = _innovation(h, reading, i, work)
        bound = reading.bounds[i]
        # Outliers are spread over a multiple of the region where the tip is expected.
        spread *= bound / math.sqrt(bound * bound + 3.0 * variance)
        mass, mean, share = _weigh_noises(h, reading, i, innovation, variance, assumed, work)
        likelihood *= mass
        # e <- e + c mean / sigma, P <- P - c c^T (1 - share) / sigma^2
        work.reduction[i] = (1.0 - share) / variance
        moved = mean / math.sqrt(variance)
        for k in range(ERROR):
            work.change[k] += work.cross_covariance[i, k] * moved
    outlier = assumed.outlier_share * spread
    evidence = outlier + (1.0 - assumed.outlier_share) * likelihood
    h.evidence, h.outlier = evidence, outlier / evidence
    _update_noise_weights(h, assumed, work)
    reduce_covariance(h.covariance, h.outlier, work)
    apply_change(h, h.outlier, assumed, work)
    for k in range(3):
        h.residual[k] += (1.0 - h.outlier) * (reading.tip[k] - h.position[k] - h.residual[k])


@compiled
def _innovation(h: Any, reading: Reading, i: int, work: Workspace) -> tuple[float, float]:
    """Return innovation and variance of one coordinate; compute its covariances with the error."""
    p, c, y = h.covariance, work.cross_covariance, reading.values[i]
    ux, uy, uz = reading.directions[i, 0], reading.directions[i, 1], reading.directions[i, 2]
    # c = P u, u the direction of the reading in the position ...
    for k in range(ERROR):
        c[i, k] = ux * p[0, k] + uy * p[1, k] + uz * p[2, k]
    # ... less the reduction by the previous coordinates: (P - sum_b n_b c_b c_b^T) u.
    for b in range(i):
        by = work.reduction[b] * (ux * c[b, 0] + uy * c[b, 1] + uz * c[b, 2])
        for k in range(ERROR):
            c[i, k] -= by * c[b, k]
    # nu = y - u (p + dp), variance u^T P u
    x, change = h.position, work.change
    predicted = ux * (x[0] + change[0]) + uy * (x[1] + change[1]) + uz * (x[2] + change[2])
    return y - predicted, ux * c[i, 0] + uy * c[i, 1] + uz * c[i, 2]


@compiled
def _weigh_noises(
    h: Any,
    reading: Reading,
    i: int,
    innovation: float,
    variance: float,
    assumed: Any,
    work: Workspace,
) -> tuple[float, float, float]:
    """Mix the updates of all noise models for one coordinate.

    Returns
    -------
    mass, mean, share : float
        Likelihood of the coordinate, relative to that within the claimed bound; change of the
        estimate in standard deviations; remaining share of the variance.
    """
    bound, deviation, shape = reading.bounds[i], math.sqrt(variance), h.shape
    shares, noises = work.shares, assumed.noises
    # Equal noise in all coordinates: continue with the probabilities of the previous coordinate.
    row = i if shape == CORRELATED else 0
    per_deviation, per_variance = 1.0 / deviation, 1.0 / variance
    claimed = max(bound * bound / 3.0, assumed.model_error)
    last = moved_by = 0.0
    for k in range(3):
        last += reading.directions[i, k] * h.residual[k]
        moved_by += reading.directions[i, k] * work.change[k]
    # Skip impossible models explicitly: the compiler would evaluate a branch for all of them.
    possible, count = work.possible, 0
    for m in range(NOISES):
        if shares[row, m] > 0.0:
            possible[count] = m
            count += 1
    mass = mean = square = 0.0
    for n in range(count):
        m = possible[n]
        size = noises[shape, 0, m] * bound
        if shape == UNIFORM:
            # Prior N(0, sigma^2) of the coordinate, truncated to nu +- size.
            likely, middle, rest = truncated_moments(
                (innovation - size) * per_deviation, (innovation + size) * per_deviation
            )
            likely *= bound / size
        else:
            c, measured = noises[shape, 2, m], max(size * size / 3.0, assumed.model_error)
            old = min(variance, measured)
            # Variance of d' - c d; the error of the model is not correlated.
            new = variance - c * (2.0 - c) * old + 2.0 * c * c * assumed.model_error
            total = new + (1.0 - c * c) * measured
            difference = innovation - c * (last - moved_by * old * per_variance)
            per_total = 1.0 / total
            likely = 2.0 * bound * DENSITY * math.sqrt(per_total)
            likely *= math.exp(-0.5 * difference * difference * per_total)
            # Noise smaller than claimed is possible, but the gain does not rely on it.
            if measured < claimed:
                total = new + (1.0 - c * c) * claimed
                per_total = 1.0 / total
            gain = (variance - c * old) * per_deviation * per_total
            middle, rest = gain * difference, 1.0 - gain * gain * total
        shares[row, m] *= likely
        mass += shares[row, m]
        mean += shares[row, m] * middle
        square += shares[row, m] * (rest + middle * middle)
    per_mass = 1.0 / max(mass, _NO_MASS)
    for m in range(NOISES):
        shares[row, m] *= per_mass
    mean *= per_mass
    share = min(max(square * per_mass - mean * mean, _SMALLEST_SHARE), 1.0)
    return mass, mean, share


@compiled
def tail_ratio(z: float) -> float:
    """Return P(Z > z) / exp(-z^2 / 2) of a standard normal Z for z in [0, 5.7].

    A minimax polynomial in 1 / (1 + 0.3 z) with a relative error of 1.4e-8; it takes half the time
    of `math.erfc`.
    """
    t = 1.0 / (1.0 + 0.3 * z)
    r = -0.1179682526 + t * 0.02860580021
    r = 0.0689985356 + t * (0.1134081515 + t * r)
    r = 0.1493868939 + t * (0.029914577 + t * r)
    r = 0.1222031494 + t * (0.1056383493 + t * r)
    return -0.0001871974762 + t * r


@compiled
def truncated_moments(lower: float, upper: float) -> tuple[float, float, float]:
    """Return mass, mean and variance of a standard normal between two bounds.

    Without mass, mean and variance are meaningless, but finite.

    Parameters
    ----------
    lower, upper : float
        The bounds; those beyond 5.5 are ignored (an error below 1e-6).
    """
    if lower <= -_FAR and upper >= _FAR:
        return 1.0, 0.0, 1.0
    below, above = min(abs(lower), _FAR), min(abs(upper), _FAR)
    # phi(z) and the tail Q(|z|) at both bounds.
    bell_lower = math.exp(-0.5 * below * below) if below < _FAR else 0.0
    bell_upper = math.exp(-0.5 * above * above) if above < _FAR else 0.0
    tail_lower, tail_upper = bell_lower * tail_ratio(below), bell_upper * tail_ratio(above)
    bell_lower, bell_upper = DENSITY * bell_lower, DENSITY * bell_upper
    # Differences of small tails are more accurate than those of numbers near 1.
    if lower > 0.0:
        mass = tail_lower - tail_upper
    elif upper < 0.0:
        mass = tail_upper - tail_lower
    else:
        mass = 1.0 - tail_lower - tail_upper
    # mean = (phi(a) - phi(b)) / mass, variance = 1 + (a phi(a) - b phi(b)) / mass - mean^2
    per_mass = 1.0 / max(mass, _NO_MASS)
    mean = (bell_lower - bell_upper) * per_mass
    variance = 1.0 + (lower * bell_lower - upper * bell_upper) * per_mass - mean * mean
    return mass, mean, variance


@compiled
def _update_noise_weights(h: Any, assumed: Any, work: Workspace) -> None:
    """Update the noise weights, unless the tip is an outlier."""
    weights = h.noise_weights
    for i in range(3 if h.shape == CORRELATED else 1):
        kept = 0.0
        for m in range(NOISES):
            likely = (1.0 - h.outlier) * work.shares[i, m] + h.outlier * weights[i, m]
            # After an outlier, widen the weights of the noise models.
            likely += _RESTORED_SHARE * h.outlier * (assumed.noises[h.shape, 1, m] - likely)
            weights[i, m] = likely if likely > _DROPPED_SHARE else 0.0
            kept += weights[i, m]
        for m in range(NOISES):
            weights[i, m] /= kept


@compiled
def reduce_covariance(p: Array, outlier: float, work: Workspace) -> None:
    """Reduce the covariance; mix it with the old one by the probability of an outlier.

    P <- P - (1 - o) sum_i n_i c_i c_i^T + o (1 - o) e e^T
    """
    inside = 1.0 - outlier
    n, c, change = work.reduction, work.cross_covariance, work.change
    for a in range(ERROR):
        n0, n1, n2 = inside * n[0] * c[0, a], inside * n[1] * c[1, a], inside * n[2] * c[2, a]
        apart = inside * outlier * change[a]
        for b in range(ERROR):
            p[a, b] += apart * change[b] - (n0 * c[0, b] + n1 * c[1, b] + n2 * c[2, b])


@compiled
def apply_change(h: Any, outlier: float, assumed: Any, work: Workspace) -> None:
    """Apply the change of the error; a change of the torsion also changes the tip's angle."""
    inside, change = 1.0 - outlier, work.change
    for k in range(ERROR):
        change[k] *= inside
    for k in range(3):
        h.position[k] += change[k]
    kappa = h.curvature + change[E_KAPPA]
    h.curvature = min(max(kappa, assumed.smallest_curvature), assumed.largest_curvature)
    h.scale += change[E_SCALE]
    if h.torsion_kind == GAIN:
        gain = min(max(h.gain + change[E_TORSION], _SMALLEST_GAIN), _LARGEST_GAIN)
        h.tip_angle += h.dtip_dtorsion * (gain - h.gain)
        h.gain, h.behind_play = gain, h.tip_angle
    elif change[E_TORSION] != 0.0 and h.torsion_kind == LAG:
        lag = min(max(h.lag + change[E_TORSION], _SMALLEST_LAG), _LARGEST_LAG)
        h.tip_angle += h.dtip_dtorsion * (lag - h.lag)
        h.lag = lag
    elif change[E_TORSION] != 0.0:
        play = min(max(h.play + change[E_TORSION], 0.0), _LARGEST_PLAY)
        h.tip_angle += h.dtip_dtorsion * (play - h.play)
        h.play, h.behind_play = play, h.tip_angle
    rotate(h.rotation, change[E_TURN], change[E_TURN + 1], change[E_TURN + 2])
