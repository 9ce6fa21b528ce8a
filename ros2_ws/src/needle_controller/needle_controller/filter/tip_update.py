"""One measured tip into a hypothesis, whatever its noise may be; compiled.

Several noise models are thought possible, each uniform within a bound or normal, and besides them
that the tip is an outlier, which says nothing. Uniform noise says that the tip lies in a box around
the measured one: the posterior of a Gaussian prior is that Gaussian cut off outside the box.
Coordinate after coordinate the mixture of what the models say is replaced by the Gaussian of the
same mean and variance (assumed-density filtering; truncated normals have these in closed form). In
the end the estimate is the mixture of that and of what it was before, by how likely the tip was an
outlier. A correlated tip is taken along directions in which its errors are independent.

Where a share c of an error is left in the next one, e' = c e + sqrt(1 - c^2) w, w of variance R,
what a tip is off the estimate, less c times what the one before was (after its update), is

    d' - c d + sqrt(1 - c^2) w

with d and d' what the estimate is off the needle at both. Of the variance of d' as much as R was
there before, for no estimate is less certain than its tip; the rest is new.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from needle_controller.filter.hypotheses import LASTING, UNIFORM
from needle_controller.filter.motion import rotate
from needle_controller.filter.records import (
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    ERROR,
    NOISES,
)
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled

SMALLEST_VARIANCE = 1e-18
"""Of a measured coordinate [m^2]: an exact one would leave nothing to divide by."""
_SMALLEST_SHARE = 0.02
_NO_MASS = 1e-30
_GIVEN_UP = 1e-3
_REOPENED = 0.2
_FAR = 5.5
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)
_PER_ROOT_2 = math.sqrt(0.5)


class Reading(NamedTuple):
    """A tip along directions in which its errors are independent."""

    tip: Array  # shape (3,) [m]
    covariance: Array  # (3, 3) [m^2]
    directions: Array  # rows, (3, 3): those of L^-1, covariance = L D L^T
    values: Array  # the tip along them, (3,) [m]
    bounds: Array  # what is claimed, (3,): sqrt(3) standard deviations [m]


class Work(NamedTuple):
    """Working memory of an update."""

    covaried: Array  # of each coordinate with the error, after those before it, (3, 9)
    narrowing: Array  # how much each coordinate narrows the covariance along that, (3,)
    change: Array  # of the error's mean, (9,)
    shares: Array  # probability of each noise model by each coordinate, (3, NOISES)
    gain: Array  # of `advance_hypothesis`, (6, 6)


@compiled
def new_work() -> Work:
    """Return working memory."""
    return Work(
        np.empty((3, ERROR)),
        np.empty(3),
        np.empty(ERROR),
        np.empty((3, NOISES)),
        np.empty((6, 6)),
    )


@compiled
def new_reading() -> Reading:
    """Return room for a tip."""
    return Reading(np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3))


@compiled
def read_tip(reading: Reading) -> bool:
    """Write all that follows from tip and covariance; return whether both are finite."""
    tip, covariance = reading.tip, reading.covariance
    for i in range(3):
        if not math.isfinite(tip[i]):
            return False
        for j in range(3):
            if not math.isfinite(covariance[i, j]):
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
def update_hypothesis(h: Any, reading: Reading, known: Any, work: Work) -> None:
    """Take a tip.

    Parameters
    ----------
    h : HYPOTHESIS, changed
        The hypothesis. `evidence` becomes the tip's likelihood, relative to noise within the
        claimed bounds, `outlier` the share of it that outliers have.
    reading : Reading
        The tip, after `read_tip`.
    known : ASSUMPTIONS
        What the estimates are kept to, which noise is thought possible, and how many tips are
        outliers.
    work : Work
        Working memory.
    """
    work.change[:] = 0.0
    likelihood, spread = 1.0, known.outlier_density
    for i in range(3):
        innovation, variance = _innovation(h, reading, i, work)
        bound = reading.bounds[i]
        # Outliers are spread over a multiple of where the tip is expected. A hypothesis that is
        # linear in the roll knows less than it thinks, unless it knows next to nothing.
        precise = bound * bound / (bound * bound + 3.0 * variance)
        spread *= math.sqrt(precise)
        variance += known.softness + known.mistrust * precise * variance
        mass, mean, share = _weigh_noises(h, reading, i, innovation, variance, known, work)
        likelihood *= mass
        # e <- e + c mean / sigma, P <- P - c c^T (1 - share) / sigma^2
        work.narrowing[i] = (1.0 - share) / variance
        for k in range(ERROR):
            work.change[k] += work.covaried[i, k] * mean / math.sqrt(variance)
    outlier = known.outlier_share * spread
    evidence = outlier + (1.0 - known.outlier_share) * likelihood
    h.evidence, h.outlier = evidence, outlier / evidence
    _learn_noise(h, known, work)
    _narrow(h.covariance, h.outlier, work)
    _apply(h, reading, known, work)


@compiled
def _innovation(h: Any, reading: Reading, i: int, work: Work) -> tuple[float, float]:
    """Return innovation and variance of one coordinate; write its covariances with the error."""
    u, p, own = reading.directions[i], h.covariance, work.covaried[i]
    # c = P u, u the direction of the reading in the position ...
    for k in range(ERROR):
        own[k] = u[0] * p[0, k] + u[1] * p[1, k] + u[2] * p[2, k]
    # ... less what the coordinates before have narrowed: (P - sum_b n_b c_b c_b^T) u.
    for b in range(i):
        other = work.covaried[b]
        by = work.narrowing[b] * (u[0] * other[0] + u[1] * other[1] + u[2] * other[2])
        for k in range(ERROR):
            own[k] -= by * other[k]
    # nu = y - u (p + dp), variance u^T P u
    innovation, variance = reading.values[i], 0.0
    for k in range(3):
        innovation -= u[k] * (h.position[k] + work.change[k])
        variance += u[k] * own[k]
    return innovation, variance


@compiled
def _weigh_noises(
    h: Any,
    reading: Reading,
    i: int,
    innovation: float,
    variance: float,
    known: Any,
    work: Work,
) -> tuple[float, float, float]:
    """Mix what the noise models say of one coordinate.

    Returns
    -------
    mass, mean, share : float
        The coordinate's likelihood, relative to that within the claimed bound; by how many standard
        deviations it moves the estimate; and what is left of the variance, as a share of it.
    """
    u, bound, deviation = reading.directions[i], reading.bounds[i], math.sqrt(variance)
    multiples, lastings = known.noises[h.shape, 0], known.noises[h.shape, 2]
    last = taken = 0.0
    for k in range(3):
        last += u[k] * h.residual[k]
        taken += u[k] * work.change[k]
    # Noise that is the same in all coordinates is what the coordinate before has shown of it.
    before = h.noise_weights[i] if h.shape == LASTING or i == 0 else work.shares[i - 1]
    shares, mass, mean, square = work.shares[i], 0.0, 0.0, 0.0
    for m in range(NOISES):
        shares[m] = 0.0
        if before[m] == 0.0:
            continue
        if h.shape == UNIFORM:
            limit = multiples[m] * bound
            # Prior N(0, sigma^2) of the coordinate, cut off outside nu +- limit.
            likely, middle, rest = truncated_moments(
                (innovation - limit) / deviation, (innovation + limit) / deviation
            )
            weight = before[m] * likely / multiples[m]
        else:
            c, noise = lastings[m], (multiples[m] * bound) ** 2 / 3.0
            measured = max(noise, known.model_error)
            old = min(variance, measured)
            # Variance of d' - c d: what the model leaves out does not last.
            new = variance - c * (2.0 - c) * old + 2.0 * c * c * known.model_error
            total = new + (1.0 - c * c) * measured
            off = innovation - c * (last - taken * old / variance)
            likely = _DENSITY * math.exp(-0.5 * off * off / total) / math.sqrt(total)
            weight = before[m] * 2.0 * bound * likely
            # Noise that is smaller than claimed is thought possible, but not relied upon.
            total = new + (1.0 - c * c) * max(measured, bound * bound / 3.0)
            gain = (variance - c * old) / (deviation * total)
            middle, rest = gain * off, 1.0 - gain * gain * total
        shares[m] = weight
        mass += weight
        mean += weight * middle
        square += weight * (rest + middle * middle)
    per_mass = 1.0 / max(mass, _NO_MASS)
    for m in range(NOISES):
        shares[m] *= per_mass
    mean *= per_mass
    share = min(max(square * per_mass - mean * mean, _SMALLEST_SHARE), 1.0)
    return mass, mean, share


@compiled
def truncated_moments(lower: float, upper: float) -> tuple[float, float, float]:
    """Return mass, mean and variance of a standard normal between two bounds.

    Where the mass vanishes, mean and variance mean nothing (they are finite).

    Parameters
    ----------
    lower, upper : float
        The bounds; those beyond 5.5 count as none (an error below 1e-6).
    """
    below, above = min(abs(lower), _FAR), min(abs(upper), _FAR)
    # phi(z) and the tail Q(|z|) at both bounds.
    bell_lower = math.exp(-0.5 * below * below) * _DENSITY if below < _FAR else 0.0
    bell_upper = math.exp(-0.5 * above * above) * _DENSITY if above < _FAR else 0.0
    tail_lower = 0.5 * math.erfc(below * _PER_ROOT_2) if below < _FAR else 0.0
    tail_upper = 0.5 * math.erfc(above * _PER_ROOT_2) if above < _FAR else 0.0
    # Differences of small tails, not of numbers near 1.
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
def _learn_noise(h: Any, known: Any, work: Work) -> None:
    """Take what the tip shows of the noise, by how likely it was none."""
    prior = known.noises[h.shape, 1]
    for i in range(3 if h.shape == LASTING else 1):
        shown, weights, kept = work.shares[i if h.shape == LASTING else 2], h.noise_weights[i], 0.0
        for m in range(NOISES):
            likely = (1.0 - h.outlier) * shown[m] + h.outlier * weights[m]
            # After an outlier, widen the weights of the noise models.
            likely += _REOPENED * h.outlier * (prior[m] - likely)
            weights[m] = likely if likely > _GIVEN_UP else 0.0
            kept += weights[m]
        for m in range(NOISES):
            weights[m] /= kept


@compiled
def _narrow(p: Array, outlier: float, work: Work) -> None:
    """Narrow the covariance; mix with what was before, by how likely the tip was an outlier.

    P <- P - (1 - o) sum_i n_i c_i c_i^T + o (1 - o) e e^T
    """
    inside = 1.0 - outlier
    n, c, change = work.narrowing, work.covaried, work.change
    for a in range(ERROR):
        n0, n1, n2 = inside * n[0] * c[0, a], inside * n[1] * c[1, a], inside * n[2] * c[2, a]
        apart = inside * outlier * change[a]
        for b in range(ERROR):
            p[a, b] += apart * change[b] - (n0 * c[0, b] + n1 * c[1, b] + n2 * c[2, b])


@compiled
def _apply(h: Any, reading: Reading, known: Any, work: Work) -> None:
    """Change the estimate; a torsion's size has turned the tip all along."""
    inside, change = 1.0 - h.outlier, work.change
    for k in range(ERROR):
        change[k] *= inside
    for k in range(3):
        h.position[k] += change[k]
        h.residual[k] += inside * (reading.tip[k] - h.position[k] - h.residual[k])
    kappa = h.curvature + change[E_KAPPA]
    h.curvature = min(max(kappa, known.smallest_curvature), known.largest_curvature)
    h.scale += change[E_SCALE]
    if change[E_SIZE] != 0.0 and h.lag > 0.0:
        lag = min(max(h.lag + change[E_SIZE], known.smallest_lag), known.largest_lag)
        h.tip_angle += h.dtip_dsize * (lag - h.lag)
        h.lag = lag
    elif change[E_SIZE] != 0.0:
        play = min(max(h.play + change[E_SIZE], 0.0), known.largest_play)
        h.tip_angle += h.dtip_dsize * (play - h.play)
        h.play, h.behind_play = play, h.tip_angle
    rotate(h.rotation, change[E_TURN], change[E_TURN + 1], change[E_TURN + 2])
