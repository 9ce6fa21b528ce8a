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
import numpy.typing as npt

from needle_controller.filter.hypotheses import GAIN, LAG, LASTING, UNIFORM
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
_SMALLEST_GAIN, _LARGEST_GAIN = 0.3, 1.5
_NO_MASS = 1e-30
_GIVEN_UP = 1e-3
_REOPENED = 0.2
_FAR = 5.5
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


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
    possible: npt.NDArray[np.int64]  # numbers of the noise models that are, (NOISES,)


@compiled
def new_work() -> Work:
    """Return working memory."""
    return Work(
        np.empty((3, ERROR)),
        np.empty(3),
        np.empty(ERROR),
        np.empty((3, NOISES)),
        np.empty(NOISES, dtype=np.int64),
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
    for i in range(3):
        for m in range(NOISES):
            work.shares[i, m] = h.noise_weights[i, m]
    likelihood, spread = 1.0, known.outlier_density
    for i in range(3):
        innovation, variance = _innovation(h, reading, i, work)
        bound = reading.bounds[i]
        # Outliers are spread over a multiple of where the tip is expected.
        spread *= bound / math.sqrt(bound * bound + 3.0 * variance)
        mass, mean, share = _weigh_noises(h, reading, i, innovation, variance, known, work)
        likelihood *= mass
        # e <- e + c mean / sigma, P <- P - c c^T (1 - share) / sigma^2
        work.narrowing[i] = (1.0 - share) / variance
        moved = mean / math.sqrt(variance)
        for k in range(ERROR):
            work.change[k] += work.covaried[i, k] * moved
    outlier = known.outlier_share * spread
    evidence = outlier + (1.0 - known.outlier_share) * likelihood
    h.evidence, h.outlier = evidence, outlier / evidence
    _learn_noise(h, known, work)
    _narrow(h.covariance, h.outlier, work)
    _apply(h, reading, known, work)


@compiled
def _innovation(h: Any, reading: Reading, i: int, work: Work) -> tuple[float, float]:
    """Return innovation and variance of one coordinate; write its covariances with the error."""
    p, c, y = h.covariance, work.covaried, reading.values[i]
    ux, uy, uz = reading.directions[i, 0], reading.directions[i, 1], reading.directions[i, 2]
    # c = P u, u the direction of the reading in the position ...
    for k in range(ERROR):
        c[i, k] = ux * p[0, k] + uy * p[1, k] + uz * p[2, k]
    # ... less what the coordinates before have narrowed: (P - sum_b n_b c_b c_b^T) u.
    for b in range(i):
        by = work.narrowing[b] * (ux * c[b, 0] + uy * c[b, 1] + uz * c[b, 2])
        for k in range(ERROR):
            c[i, k] -= by * c[b, k]
    # nu = y - u (p + dp), variance u^T P u
    x, change = h.position, work.change
    seen = ux * (x[0] + change[0]) + uy * (x[1] + change[1]) + uz * (x[2] + change[2])
    return y - seen, ux * c[i, 0] + uy * c[i, 1] + uz * c[i, 2]


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
    bound, deviation, shape = reading.bounds[i], math.sqrt(variance), h.shape
    shares, noises = work.shares, known.noises
    # Noise that is the same in all coordinates is what the coordinates before have shown of it.
    row = i if shape == LASTING else 0
    per_deviation, per_variance = 1.0 / deviation, 1.0 / variance
    claimed = max(bound * bound / 3.0, known.model_error)
    last = taken = 0.0
    for k in range(3):
        last += reading.directions[i, k] * h.residual[k]
        taken += reading.directions[i, k] * work.change[k]
    # Only models that are thought possible: a compiler reckons a branch for all, and then picks.
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
            # Prior N(0, sigma^2) of the coordinate, cut off outside nu +- size.
            likely, middle, rest = truncated_moments(
                (innovation - size) * per_deviation, (innovation + size) * per_deviation
            )
            likely *= bound / size
        else:
            c, measured = noises[shape, 2, m], max(size * size / 3.0, known.model_error)
            old = min(variance, measured)
            # Variance of d' - c d: what the model leaves out does not last.
            new = variance - c * (2.0 - c) * old + 2.0 * c * c * known.model_error
            total = new + (1.0 - c * c) * measured
            off = innovation - c * (last - taken * old * per_variance)
            per_total = 1.0 / total
            likely = 2.0 * bound * _DENSITY * math.sqrt(per_total)
            likely *= math.exp(-0.5 * off * off * per_total)
            # Noise that is smaller than claimed is thought possible, but not relied upon.
            if measured < claimed:
                total = new + (1.0 - c * c) * claimed
                per_total = 1.0 / total
            gain = (variance - c * old) * per_deviation * per_total
            middle, rest = gain * off, 1.0 - gain * gain * total
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
    """Return P(Z > z) / exp(-z^2 / 2) of a standard normal Z for z in [0, 5.7], to 1.4e-8 of it.

    A polynomial in 1 / (1 + 0.3 z), fitted for the least largest relative error: half of the time
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

    Where the mass vanishes, mean and variance mean nothing (they are finite).

    Parameters
    ----------
    lower, upper : float
        The bounds; those beyond 5.5 count as none (an error below 1e-6).
    """
    if lower <= -_FAR and upper >= _FAR:
        return 1.0, 0.0, 1.0
    below, above = min(abs(lower), _FAR), min(abs(upper), _FAR)
    # phi(z) and the tail Q(|z|) at both bounds.
    bell_lower = math.exp(-0.5 * below * below) if below < _FAR else 0.0
    bell_upper = math.exp(-0.5 * above * above) if above < _FAR else 0.0
    tail_lower, tail_upper = bell_lower * tail_ratio(below), bell_upper * tail_ratio(above)
    bell_lower, bell_upper = _DENSITY * bell_lower, _DENSITY * bell_upper
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
    weights = h.noise_weights
    for i in range(3 if h.shape == LASTING else 1):
        kept = 0.0
        for m in range(NOISES):
            likely = (1.0 - h.outlier) * work.shares[i, m] + h.outlier * weights[i, m]
            # After an outlier, widen the weights of the noise models.
            likely += _REOPENED * h.outlier * (known.noises[h.shape, 1, m] - likely)
            weights[i, m] = likely if likely > _GIVEN_UP else 0.0
            kept += weights[i, m]
        for m in range(NOISES):
            weights[i, m] /= kept


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
    if h.sized == GAIN:
        gain = min(max(h.gain + change[E_SIZE], _SMALLEST_GAIN), _LARGEST_GAIN)
        h.tip_angle += h.dtip_dsize * (gain - h.gain)
        h.gain, h.behind_play = gain, h.tip_angle
    elif change[E_SIZE] != 0.0 and h.sized == LAG:
        lag = min(max(h.lag + change[E_SIZE], known.smallest_lag), known.largest_lag)
        h.tip_angle += h.dtip_dsize * (lag - h.lag)
        h.lag = lag
    elif change[E_SIZE] != 0.0:
        play = min(max(h.play + change[E_SIZE], 0.0), known.largest_play)
        h.tip_angle += h.dtip_dsize * (play - h.play)
        h.play, h.behind_play = play, h.tip_angle
    rotate(h.rotation, change[E_TURN], change[E_TURN + 1], change[E_TURN + 2])
