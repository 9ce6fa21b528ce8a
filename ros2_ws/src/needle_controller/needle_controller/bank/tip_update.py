"""One measured tip into estimates: Gaussian noise, or noise within a bound; compiled.

Noise within a bound says only that the tip lies in a box around the measured one. The exact
posterior of a Gaussian prior is then that Gaussian cut off outside the box; it is replaced, one
coordinate after the other, by the Gaussian of the same mean and variance (assumed-density
filtering; the moments of a truncated normal are closed form). A prior that lies well inside the box
learns nothing, one at its edge much: with uniform noise that halves the error of a Kalman filter
with the noise's variance.

Gaussian noise is taken one coordinate after the other too, along directions in which it is not
correlated. Blocks and the order of the error are those of `hypothesis_lanes`.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
# A symmetric 8 x 8 matrix is 36 lines.
# ruff: noqa: PLR0915
from __future__ import annotations

import math

from needle_common.compiled import compiled, inlined
from needle_controller.bank.hypothesis_lanes import (
    BLOCK,
    KAPPA,
    LANES,
    P00,
    P10,
    P11,
    P20,
    P21,
    P22,
    P30,
    P31,
    P32,
    P33,
    P40,
    P41,
    P42,
    P43,
    P44,
    P50,
    P51,
    P52,
    P53,
    P54,
    P55,
    P60,
    P61,
    P62,
    P63,
    P64,
    P65,
    P66,
    P70,
    P71,
    P72,
    P73,
    P74,
    P75,
    P76,
    P77,
    R00,
    R01,
    R02,
    R10,
    R11,
    R12,
    R20,
    R21,
    R22,
    SIZE_CHANGE,
    SURPRISE,
    TURN_X,
    TURN_Y,
    TURN_Z,
    WEIGHT,
    X,
    Y,
    Z,
)
from needle_controller.bank.normal_moments import truncated_moments
from needle_controller.bank.tip_motion import rotation_factors
from needle_controller.model.arrays import Array

SMALLEST_MASS = 1e-7
"""A prior with less than this in the box is taken to its edge."""
SMALLEST_VARIANCE = 1e-18
"""Of a measured coordinate [m^2]: an exact one would leave nothing to divide by."""
_SMALLEST_SHARE = 0.02
_EDGE_SHARE = 0.5
_LARGEST_TURN = 1.5


@compiled
def take_bounded(block: Array, tip: Array, bound: float, softness: float, surprise: float) -> None:
    """Take a tip whose coordinates are each within a bound of the truth.

    The weights are multiplied by the probability of the box.

    Parameters
    ----------
    block : ndarray, shape (BLOCK,), changed
        Eight estimates.
    tip : ndarray, shape (3,)
        The measured tip [m].
    bound : float
        Half the box's edge [m].
    softness : float
        Variance by which the box's edges are blurred [m^2].
    surprise : float
        Probability, for each coordinate, of a tip that the estimate does not explain: no single tip
        is taken as proof against it.
    """
    _begin(block)
    _take_within(block, 1.0, 0.0, 0.0, tip[0], bound, softness, surprise)
    _take_within(block, 0.0, 1.0, 0.0, tip[1], bound, softness, surprise)
    _take_within(block, 0.0, 0.0, 1.0, tip[2], bound, softness, surprise)
    _end(block)


@compiled
def take_gaussian(block: Array, tip: Array, noise: Array) -> None:
    """Take a tip with Gaussian noise of a given covariance: an extended Kalman filter's update.

    The weights are multiplied by all of the likelihood's density but exp(-d/2), relative to a tip's
    at the middle of its noise; d, the squared Mahalanobis distance, is written into `SURPRISE`.

    Parameters
    ----------
    block, tip :
        As in `take_bounded`.
    noise : ndarray, shape (3, 3)
        Covariance of the measured tip [m^2].
    """
    _begin(block)
    # noise = L D L^T; the rows of L^-1 are the directions.
    d0 = max(noise[0, 0], SMALLEST_VARIANCE)
    l10, l20 = noise[1, 0] / d0, noise[2, 0] / d0
    d1 = max(noise[1, 1] - l10 * l10 * d0, SMALLEST_VARIANCE)
    l21 = (noise[2, 1] - l20 * l10 * d0) / d1
    d2 = max(noise[2, 2] - l20 * l20 * d0 - l21 * l21 * d1, SMALLEST_VARIANCE)
    x, y = tip[0], tip[1] - l10 * tip[0]
    z = tip[2] - l21 * y - l20 * x
    _take_with_variance(block, 1.0, 0.0, 0.0, x, d0)
    _take_with_variance(block, -l10, 1.0, 0.0, y, d1)
    _take_with_variance(block, l21 * l10 - l20, -l21, 1.0, z, d2)
    _end(block)


@compiled
def squared_distance(block: Array, h: int, tip: Array, noise: Array) -> float:
    """Return a tip's squared Mahalanobis distance from one estimate, coordinates one by one.

    Parameters
    ----------
    block, tip, noise :
        As in `take_gaussian`; only the noise's diagonal counts.
    h : int
        Which of the eight.
    """
    x, y, z = tip[0] - block[X + h], tip[1] - block[Y + h], tip[2] - block[Z + h]
    return float(
        x * x / (block[P00 + h] + noise[0, 0])
        + y * y / (block[P11 + h] + noise[1, 1])
        + z * z / (block[P22 + h] + noise[2, 2])
    )


@inlined
def _begin(block: Array) -> None:
    for h in range(LANES):
        block[TURN_X + h] = block[TURN_Y + h] = block[TURN_Z + h] = 0.0
        block[SIZE_CHANGE + h] = block[SURPRISE + h] = 0.0


@inlined
def _take_within(
    block: Array,
    ux: float,
    uy: float,
    uz: float,
    measured: float,
    bound: float,
    softness: float,
    surprise: float,
) -> None:
    """Take one coordinate, along (ux, uy, uz), within a bound."""
    p = block
    for h in range(LANES):
        variance = _variance(p, h, ux, uy, uz) + softness
        per_deviation = 1.0 / math.sqrt(variance)
        innovation = measured - ux * p[X + h] - uy * p[Y + h] - uz * p[Z + h]
        lower, upper = (innovation - bound) * per_deviation, (innovation + bound) * per_deviation
        mass, mean, share = truncated_moments(lower, upper)
        outside = mass < SMALLEST_MASS
        share = min(max(share, _SMALLEST_SHARE), 1.0)
        share = _EDGE_SHARE if outside else share
        edge = lower if innovation > 0.0 else upper
        mean = edge if outside else mean
        mass = 0.0 if outside else mass
        p[WEIGHT + h] *= mass + surprise * (1.0 - mass)
        _narrow(
            p, h, ux, uy, uz, mean * per_deviation, (1.0 - share) * (per_deviation * per_deviation)
        )


@inlined
def _take_with_variance(
    block: Array, ux: float, uy: float, uz: float, measured: float, noise: float
) -> None:
    """Take one coordinate, along (ux, uy, uz), with Gaussian noise of a variance."""
    p = block
    for h in range(LANES):
        narrowing = 1.0 / (_variance(p, h, ux, uy, uz) + noise)
        innovation = measured - ux * p[X + h] - uy * p[Y + h] - uz * p[Z + h]
        p[SURPRISE + h] += innovation * innovation * narrowing
        p[WEIGHT + h] *= math.sqrt(noise * narrowing)
        _narrow(p, h, ux, uy, uz, innovation * narrowing, narrowing)


@inlined
def _variance(p: Array, h: int, ux: float, uy: float, uz: float) -> float:
    along_x = ux * p[P00 + h] + 2.0 * (uy * p[P10 + h] + uz * p[P20 + h])
    along_y = uy * p[P11 + h] + 2.0 * uz * p[P21 + h]
    return float(ux * along_x + uy * along_y + uz * uz * p[P22 + h])


@inlined
def _narrow(
    p: Array, h: int, ux: float, uy: float, uz: float, shift: float, narrowing: float
) -> None:
    """Shift an estimate by its covariance with a coordinate, and take that's square off."""
    c0 = ux * p[P00 + h] + uy * p[P10 + h] + uz * p[P20 + h]
    c1 = ux * p[P10 + h] + uy * p[P11 + h] + uz * p[P21 + h]
    c2 = ux * p[P20 + h] + uy * p[P21 + h] + uz * p[P22 + h]
    c3 = ux * p[P30 + h] + uy * p[P31 + h] + uz * p[P32 + h]
    c4 = ux * p[P40 + h] + uy * p[P41 + h] + uz * p[P42 + h]
    c5 = ux * p[P50 + h] + uy * p[P51 + h] + uz * p[P52 + h]
    c6 = ux * p[P60 + h] + uy * p[P61 + h] + uz * p[P62 + h]
    c7 = ux * p[P70 + h] + uy * p[P71 + h] + uz * p[P72 + h]
    p[X + h] += c0 * shift
    p[Y + h] += c1 * shift
    p[Z + h] += c2 * shift
    p[TURN_X + h] += c3 * shift
    p[TURN_Y + h] += c4 * shift
    p[TURN_Z + h] += c5 * shift
    p[KAPPA + h] += c6 * shift
    p[SIZE_CHANGE + h] += c7 * shift
    scaled = c0 * narrowing
    p[P00 + h] -= scaled * c0
    scaled = c1 * narrowing
    p[P10 + h] -= scaled * c0
    p[P11 + h] -= scaled * c1
    scaled = c2 * narrowing
    p[P20 + h] -= scaled * c0
    p[P21 + h] -= scaled * c1
    p[P22 + h] -= scaled * c2
    scaled = c3 * narrowing
    p[P30 + h] -= scaled * c0
    p[P31 + h] -= scaled * c1
    p[P32 + h] -= scaled * c2
    p[P33 + h] -= scaled * c3
    scaled = c4 * narrowing
    p[P40 + h] -= scaled * c0
    p[P41 + h] -= scaled * c1
    p[P42 + h] -= scaled * c2
    p[P43 + h] -= scaled * c3
    p[P44 + h] -= scaled * c4
    scaled = c5 * narrowing
    p[P50 + h] -= scaled * c0
    p[P51 + h] -= scaled * c1
    p[P52 + h] -= scaled * c2
    p[P53 + h] -= scaled * c3
    p[P54 + h] -= scaled * c4
    p[P55 + h] -= scaled * c5
    scaled = c6 * narrowing
    p[P60 + h] -= scaled * c0
    p[P61 + h] -= scaled * c1
    p[P62 + h] -= scaled * c2
    p[P63 + h] -= scaled * c3
    p[P64 + h] -= scaled * c4
    p[P65 + h] -= scaled * c5
    p[P66 + h] -= scaled * c6
    scaled = c7 * narrowing
    p[P70 + h] -= scaled * c0
    p[P71 + h] -= scaled * c1
    p[P72 + h] -= scaled * c2
    p[P73 + h] -= scaled * c3
    p[P74 + h] -= scaled * c4
    p[P75 + h] -= scaled * c5
    p[P76 + h] -= scaled * c6
    p[P77 + h] -= scaled * c7


@inlined
def _end(block: Array) -> None:
    """Turn the orientations by what was collected; a single tip turns none by more than 1.5 rad."""
    # Were the number of lanes known, the compiler would unroll the loop and do one after the other.
    for h in range(block.size // (BLOCK // LANES)):
        rotate(block, h, block[TURN_X + h], block[TURN_Y + h], block[TURN_Z + h])


@inlined
def rotate(p: Array, h: int, x: float, y: float, z: float) -> None:
    """Turn an orientation by a vector in `target_plane`, 1.5 rad at most: R <- exp(v^) R."""
    squared = x * x + y * y + z * z
    scale = _LARGEST_TURN / math.sqrt(max(squared, _LARGEST_TURN * _LARGEST_TURN))
    x, y, z = scale * x, scale * y, scale * z
    a, b, _ = rotation_factors(scale * scale * squared)
    e00, e01, e02 = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
    e10, e11, e12 = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
    e20, e21, e22 = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
    r0, r1, r2 = p[R00 + h], p[R10 + h], p[R20 + h]
    p[R00 + h] = e00 * r0 + e01 * r1 + e02 * r2
    p[R10 + h] = e10 * r0 + e11 * r1 + e12 * r2
    p[R20 + h] = e20 * r0 + e21 * r1 + e22 * r2
    r0, r1, r2 = p[R01 + h], p[R11 + h], p[R21 + h]
    p[R01 + h] = e00 * r0 + e01 * r1 + e02 * r2
    p[R11 + h] = e10 * r0 + e11 * r1 + e12 * r2
    p[R21 + h] = e20 * r0 + e21 * r1 + e22 * r2
    r0, r1, r2 = p[R02 + h], p[R12 + h], p[R22 + h]
    p[R02 + h] = e00 * r0 + e01 * r1 + e02 * r2
    p[R12 + h] = e10 * r0 + e11 * r1 + e12 * r2
    p[R22 + h] = e20 * r0 + e21 * r1 + e22 * r2
