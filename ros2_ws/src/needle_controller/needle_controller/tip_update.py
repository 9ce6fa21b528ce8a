"""One measured tip into one Gaussian estimate: Gaussian noise, or noise within a bound; compiled.

Noise within a bound says only that the tip lies in a box around the measured one. The exact
posterior of a Gaussian prior is then that Gaussian cut off outside the box; it is replaced, one
coordinate after the other, by the Gaussian of the same mean and variance (assumed-density
filtering; the moments of a truncated normal are closed form). A prior that lies well inside the box
learns nothing, one at its edge much: with uniform noise that halves the error of a Kalman filter
with the noise's variance.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math

from needle_common.compiled import compiled
from needle_controller.arrays import Array
from needle_controller.tip_motion import ERROR, rotate

SMALLEST_MASS = 1e-7
"""A prior with less than this in the box is taken to its edge."""
_SMALLEST_SHARE = 0.02
_EDGE_SHARE = 0.5
_FAR = 5.0
_ROOT_HALF = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


@compiled
def truncated_moments(lower: float, upper: float) -> tuple[float, float, float]:
    """Return mass, mean and variance of a standard normal between two bounds.

    Bounds beyond 5 standard deviations count as none (an error below 1e-5); a mass below
    `SMALLEST_MASS` comes back as it is, with mean and variance 0.
    """
    density_lower = density_upper = 0.0
    lower_term = upper_term = 0.0
    below = above = 0.0
    if lower > -_FAR:
        density_lower = _DENSITY * math.exp(-0.5 * lower * lower)
        lower_term = lower * density_lower
        below = 0.5 * math.erfc(-lower * _ROOT_HALF)
    if upper < _FAR:
        density_upper = _DENSITY * math.exp(-0.5 * upper * upper)
        upper_term = upper * density_upper
        above = 0.5 * math.erfc(upper * _ROOT_HALF)
    if lower > 0.0:
        # Differences of small tails, not of numbers near 1.
        mass = 0.5 * math.erfc(lower * _ROOT_HALF) - above
    elif upper < 0.0:
        mass = 0.5 * math.erfc(-upper * _ROOT_HALF) - below
    else:
        mass = 1.0 - below - above
    if mass < SMALLEST_MASS:
        return mass, 0.0, 0.0
    mean = (density_lower - density_upper) / mass
    return mass, mean, 1.0 + (lower_term - upper_term) / mass - mean * mean


@compiled
def bounded_update(
    position: Array,
    rotation: Array,
    covariance: Array,
    tip: Array,
    bound: float,
    softness: float,
    surprise: float,
    change: Array,
) -> float:
    """Take a tip whose coordinates are each within a bound of the truth.

    Parameters
    ----------
    position, rotation, covariance : ndarray, shapes (3,), (3, 3), (8, 8), changed
        The estimate, errors as in `tip_motion`.
    tip : ndarray, shape (3,)
        The measured tip [m].
    bound : float
        Half the box's edge [m].
    softness : float
        Variance by which the box's edges are blurred [m^2].
    surprise : float
        Probability, for each coordinate, of a tip that the estimate does not explain: no single tip
        is taken as proof against it.
    change : ndarray, shape (8,), written
        What was added to the estimate; position and rotation have theirs already.

    Returns
    -------
    float
        Log likelihood of the tip (of the box, that is).
    """
    p = covariance
    change[:] = 0.0
    likelihood = 0.0
    for axis in range(3):
        variance = p[axis, axis] + softness
        deviation = math.sqrt(variance)
        innovation = tip[axis] - position[axis] - change[axis]
        lower, upper = (innovation - bound) / deviation, (innovation + bound) / deviation
        if lower < -_FAR and upper > _FAR:
            continue
        mass, mean, share = truncated_moments(lower, upper)
        if mass < SMALLEST_MASS:
            likelihood += math.log(surprise)
            shift = innovation - bound if innovation > 0.0 else innovation + bound
            share = _EDGE_SHARE
        else:
            likelihood += math.log(mass + surprise * (1.0 - mass))
            shift = deviation * mean
            share = min(max(share, _SMALLEST_SHARE), 1.0)
        _narrow(p, axis, shift / variance, (1.0 - share) / variance, change)
    _apply(position, rotation, change)
    return likelihood


@compiled
def gaussian_update(
    position: Array,
    rotation: Array,
    covariance: Array,
    tip: Array,
    noise: Array,
    change: Array,
    gain: Array,
) -> float:
    """Take a tip with Gaussian noise of a given covariance: an extended Kalman filter's update.

    Parameters
    ----------
    position, rotation, covariance, tip, change :
        As in `bounded_update`.
    noise : ndarray, shape (3, 3)
        Covariance of the measured tip [m^2].
    gain : ndarray, shape (8, 3)
        Scratch.

    Returns
    -------
    float
        Log likelihood of the tip, less its constant.
    """
    p = covariance
    a, b, c = p[0, 0] + noise[0, 0], p[0, 1] + noise[0, 1], p[0, 2] + noise[0, 2]
    d, e, f = p[1, 1] + noise[1, 1], p[1, 2] + noise[1, 2], p[2, 2] + noise[2, 2]
    # Inverse of the innovation's covariance.
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * i00 + b * i01 + c * i02
    n0, n1, n2 = tip[0] - position[0], tip[1] - position[1], tip[2] - position[2]
    for i in range(ERROR):
        p0, p1, p2 = p[i, 0], p[i, 1], p[i, 2]
        gain[i, 0] = (p0 * i00 + p1 * i01 + p2 * i02) / determinant
        gain[i, 1] = (p0 * i01 + p1 * i11 + p2 * i12) / determinant
        gain[i, 2] = (p0 * i02 + p1 * i12 + p2 * i22) / determinant
        change[i] = gain[i, 0] * n0 + gain[i, 1] * n1 + gain[i, 2] * n2
    for i in range(ERROR - 1, -1, -1):
        for j in range(i, -1, -1):
            # In this order, what is read of row j is still the prior's.
            p[i, j] -= gain[i, 0] * p[j, 0] + gain[i, 1] * p[j, 1] + gain[i, 2] * p[j, 2]
    for i in range(ERROR):
        for j in range(i):
            p[j, i] = p[i, j]
    quadratic = (
        n0 * n0 * i00 + n1 * n1 * i11 + n2 * n2 * i22
        + 2.0 * (n0 * n1 * i01 + n0 * n2 * i02 + n1 * n2 * i12)
    ) / determinant  # fmt: skip
    _apply(position, rotation, change)
    return float(-0.5 * (quadratic + math.log(determinant)))


@compiled
def squared_distance(position: Array, covariance: Array, tip: Array, noise: Array) -> float:
    """Return the innovation's squared Mahalanobis distance, coordinates taken one by one.

    Parameters
    ----------
    position, covariance, tip : ndarray, shapes (3,), (8, 8), (3,)
        As in `bounded_update`.
    noise : ndarray, shape (3, 3)
        Covariance of the measured tip [m^2]; only its diagonal counts.
    """
    total = 0.0
    for axis in range(3):
        innovation = tip[axis] - position[axis]
        total += innovation * innovation / (covariance[axis, axis] + noise[axis, axis])
    return total


@compiled
def _narrow(p: Array, axis: int, shift: float, narrowing: float, change: Array) -> None:
    """Shift by a column of the covariance, and take its square off; numbers stay in registers."""
    c0, c1, c2, c3 = p[0, axis], p[1, axis], p[2, axis], p[3, axis]
    c4, c5, c6, c7 = p[4, axis], p[5, axis], p[6, axis], p[7, axis]
    change[0] += c0 * shift
    change[1] += c1 * shift
    change[2] += c2 * shift
    change[3] += c3 * shift
    change[4] += c4 * shift
    change[5] += c5 * shift
    change[6] += c6 * shift
    change[7] += c7 * shift
    for i in range(ERROR):
        scaled = p[i, axis] * narrowing
        p[i, 0] -= scaled * c0
        p[i, 1] -= scaled * c1
        p[i, 2] -= scaled * c2
        p[i, 3] -= scaled * c3
        p[i, 4] -= scaled * c4
        p[i, 5] -= scaled * c5
        p[i, 6] -= scaled * c6
        p[i, 7] -= scaled * c7


@compiled
def _apply(position: Array, rotation: Array, change: Array) -> None:
    for i in range(3):
        position[i] += change[i]
    rotate(rotation, change[3], change[4], change[5])
