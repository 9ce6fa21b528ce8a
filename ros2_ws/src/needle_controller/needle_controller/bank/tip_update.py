"""One measured tip into estimates, whatever its noise may be; compiled.

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

from needle_controller.bank.estimate_tiles import (
    BEHIND_PLAY,
    E_KAPPA,
    E_SCALE,
    E_SIZE,
    E_TURN,
    ERROR,
    EVIDENCE,
    KAPPA,
    LAG,
    NOISE,
    NOISES,
    OUTLIER,
    PER_SIZE,
    PLACE,
    PLAY,
    REMAINDER,
    SCALE,
    SHAPE,
    TIP_ANGLE,
    WEIGHT,
    R,
    X,
)
from needle_controller.bank.filter_settings import Limits
from needle_controller.bank.hypotheses import LASTING, NORMAL, UNIFORM
from needle_controller.bank.normal_moments import falling_exponential, truncated_moments
from needle_controller.bank.tip_motion import rotation_factors
from needle_controller.model.arrays import Array
from needle_core.compiled import compiled, inlined

FOUND, READ, ALONG, BOUND = 0, 1, 4, 13
READING_ROWS = 16
"""Rows of a tip: 1 if there is one; its three readings [m], the directions in which they were read,
and the noise bound claimed for each [m]."""
CHANGE, COVARIED, NARROWING = 0, 9, 36
INNOVATION, TAKEN, LAST, VARIANCE, DEVIATION, MASS, MEAN, SQUARE = range(39, 47)
OUTSIDE, LIKELIHOOD, SHARE = 47, 48, 49
SPREAD = INNOVATION
SHOWN = SHARE + 3 * NOISES
UPDATE_ROWS = SHOWN + NOISES
"""Rows of working memory: what the tip changes; each coordinate's covariances with the error, and
by how much they narrow it; of one coordinate innovation, what the coordinates before have taken of
it, what is left of the tip before, variance and standard deviation, and sums over the noise models;
the density of outliers; the tip's likelihood; each noise model's share of each coordinate, and what
one shows of the noise.
From `SPREAD` on, once the coordinates are done with: what multiplies a row of the covariances."""
_SMALLEST_SHARE = 0.02
_NO_MASS = 1e-30
_GIVEN_UP = 1e-3
_REOPENED = 0.2
_LARGEST_TURN = 1.5
_DENSITY = 2.0 / math.sqrt(2.0 * math.pi)


@compiled
def take_tip(tile: Array, reading: Array, noises: Array, limits: Limits, work: Array) -> None:
    """Take a tip of each estimate's needle.

    Parameters
    ----------
    tile : ndarray, shape (ROWS, LANES), changed
        The estimates. `EVIDENCE` becomes the tip's likelihood, relative to noise within the claimed
        bounds, `OUTLIER` the share of it that outliers have.
    reading : ndarray, shape (READING_ROWS, LANES)
        The tips; where there is none nothing changes.
    noises : ndarray, shape (3, 3, NOISES)
        For each shape of noise: sqrt(3) standard deviations of each model, or its bound, as a
        multiple of the claimed bound; how likely it is beforehand; and how much of an error is
        left at the next tip.
    limits : Limits
        What the estimates are kept to, and how many tips are outliers.
    work : ndarray, shape (UPDATE_ROWS, LANES)
        Working memory.
    """
    work[CHANGE : CHANGE + ERROR], work[OUTSIDE] = 0.0, 1.0
    work[LIKELIHOOD] = 1.0
    work[SHARE : SHARE + 3 * NOISES] = tile[NOISE : NOISE + 3 * NOISES]
    for coordinate in range(3):
        _look(tile, reading, coordinate, limits, work)
        bound = reading[BOUND + coordinate]
        if coordinate > 0:
            _hand_on(tile, coordinate, work)
        for m in range(NOISES):
            own = coordinate * NOISES + m
            if _is_thought(tile, m, UNIFORM):
                _weigh_uniform(tile, own, bound, noises[UNIFORM, 0, m], work)
            for shape, row in ((NORMAL, m), (LASTING, own)):
                if _is_thought(tile, row, shape):
                    multiple, lasting = noises[shape, 0, m], noises[shape, 2, m]
                    _weigh_normal(tile, own, shape, bound, multiple, lasting, limits, work)
        _decide(coordinate, work)
    _judge(tile, reading, noises, limits, work)
    _narrow(tile, work)
    _apply(tile, reading, limits, work)


@inlined
def _look(tile: Array, reading: Array, coordinate: int, limits: Limits, work: Array) -> None:
    """Write innovation, variance and covariances of one coordinate; begin the sums."""
    lanes, along, own = tile.shape[1], ALONG + 3 * coordinate, COVARIED + ERROR * coordinate
    for k in range(ERROR):
        x, y, z = PLACE[0, k], PLACE[1, k], PLACE[2, k]
        for h in range(lanes):
            work[own + k, h] = (
                reading[along, h] * tile[x, h]
                + reading[along + 1, h] * tile[y, h]
                + reading[along + 2, h] * tile[z, h]
            )
    # What the coordinates before have narrowed.
    for before in range(coordinate):
        others = COVARIED + ERROR * before
        for h in range(lanes):
            work[MEAN, h] = work[NARROWING + before, h] * (
                reading[along, h] * work[others, h]
                + reading[along + 1, h] * work[others + 1, h]
                + reading[along + 2, h] * work[others + 2, h]
            )
        for k in range(ERROR):
            for h in range(lanes):
                work[own + k, h] -= work[MEAN, h] * work[others + k, h]
    for h in range(lanes):
        ux, uy, uz = reading[along, h], reading[along + 1, h], reading[along + 2, h]
        work[LAST, h] = (
            ux * tile[REMAINDER, h] + uy * tile[REMAINDER + 1, h] + uz * tile[REMAINDER + 2, h]
        )
        work[TAKEN, h] = ux * work[CHANGE, h] + uy * work[CHANGE + 1, h] + uz * work[CHANGE + 2, h]
        expected = ux * tile[X, h] + uy * tile[X + 1, h] + uz * tile[X + 2, h]
        work[INNOVATION, h] = reading[READ + coordinate, h] - expected - work[TAKEN, h]
        variance = ux * work[own, h] + uy * work[own + 1, h] + uz * work[own + 2, h]
        bound = reading[BOUND + coordinate, h]
        # Where nearly nothing is known there is nothing to mistrust.
        known = bound * bound / (bound * bound + 3.0 * variance)
        variance += limits.softness + limits.mistrust * known * variance
        # Outliers are spread over a multiple of where the tip is expected.
        work[OUTSIDE, h] *= math.sqrt(known)
        work[VARIANCE, h], work[DEVIATION, h] = variance, math.sqrt(variance)
        work[MASS, h] = work[MEAN, h] = work[SQUARE, h] = 0.0


@inlined
def _hand_on(tile: Array, coordinate: int, work: Array) -> None:
    """Take noise that is the same in all coordinates for what the coordinate before has shown."""
    for m in range(coordinate * NOISES, (coordinate + 1) * NOISES):
        for h in range(tile.shape[1]):
            own, before = work[SHARE + m, h], work[SHARE + m - NOISES, h]
            work[SHARE + m, h] = own if tile[SHAPE, h] == LASTING else before


@inlined
def _is_thought(tile: Array, m: int, shape: int) -> bool:
    """Return whether any estimate that has not ended thinks a noise model possible."""
    for h in range(tile.shape[1]):
        if tile[NOISE + m, h] * tile[WEIGHT, h] > 0.0 and tile[SHAPE, h] == shape:
            return True
    return False


@inlined
def _weigh_uniform(tile: Array, m: int, bound: Array, multiple: float, work: Array) -> None:
    """Add what a uniform noise model says of a coordinate, by how likely it is."""
    for h in range(tile.shape[1]):
        per_deviation = 1.0 / work[DEVIATION, h]
        innovation, limit = work[INNOVATION, h], multiple * bound[h]
        mass, mean, variance = truncated_moments(
            (innovation - limit) * per_deviation, (innovation + limit) * per_deviation
        )
        # Read for all: read for some only, the compiler would write under a mask, at triple cost.
        is_own, others = tile[SHAPE, h] == UNIFORM, work[SHARE + m, h]
        weighed = others * mass / multiple
        weight = weighed if is_own else 0.0
        work[SHARE + m, h] = weighed if is_own else others
        work[MASS, h] += weight
        work[MEAN, h] += weight * mean
        work[SQUARE, h] += weight * (variance + mean * mean)


@inlined
def _weigh_normal(
    tile: Array,
    m: int,
    shape: int,
    bound: Array,
    multiple: float,
    lasting: float,
    limits: Limits,
    work: Array,
) -> None:
    """Add what a normal noise model says of a coordinate, by how likely it is.

    Noise that is smaller than claimed is thought possible, but not relied upon.
    """
    for h in range(tile.shape[1]):
        noise = multiple * bound[h]
        expected, measured = work[VARIANCE, h], max(noise * noise / 3.0, limits.model_error)
        before = min(expected, measured)
        known = expected - lasting * (2.0 - lasting) * before
        # What the model leaves out does not last.
        known += 2.0 * lasting * lasting * limits.model_error
        variance = known + (1.0 - lasting * lasting) * measured
        last = work[LAST, h] - work[TAKEN, h] * before / expected
        innovation = work[INNOVATION, h] - lasting * last
        per_variance = 1.0 / variance
        bell = falling_exponential(-0.5 * innovation * innovation * per_variance)
        density = _DENSITY * bound[h] * math.sqrt(per_variance) * bell
        is_own, others = tile[SHAPE, h] == shape, work[SHARE + m, h]
        weighed = others * density
        weight = weighed if is_own else 0.0
        work[SHARE + m, h] = weighed if is_own else others
        relied = max(measured, bound[h] * bound[h] / 3.0)
        variance = known + (1.0 - lasting * lasting) * relied
        gain = (expected - lasting * before) / (work[DEVIATION, h] * variance)
        mean = gain * innovation
        work[MASS, h] += weight
        work[MEAN, h] += weight * mean
        work[SQUARE, h] += weight * (1.0 - gain * gain * variance + mean * mean)


@inlined
def _decide(coordinate: int, work: Array) -> None:
    """Take one coordinate's mean and variance over the noise models."""
    lanes, own = work.shape[1], COVARIED + ERROR * coordinate
    for h in range(lanes):
        per_mass = 1.0 / max(work[MASS, h], _NO_MASS)
        mean = work[MEAN, h] * per_mass
        share = work[SQUARE, h] * per_mass - mean * mean
        share = min(max(share, _SMALLEST_SHARE), 1.0)
        work[MEAN, h] = mean / work[DEVIATION, h]
        work[NARROWING + coordinate, h] = (1.0 - share) / work[VARIANCE, h]
        work[LIKELIHOOD, h] *= work[MASS, h]
        for m in range(coordinate * NOISES, (coordinate + 1) * NOISES):
            work[SHARE + m, h] *= per_mass
    for k in range(ERROR):
        for h in range(lanes):
            work[CHANGE + k, h] += work[own + k, h] * work[MEAN, h]


@inlined
def _judge(tile: Array, reading: Array, noises: Array, limits: Limits, work: Array) -> None:
    """Say how likely the tip was, how likely an outlier, and what it shows of the noise."""
    for h in range(tile.shape[1]):
        outlier = limits.outlier_share * limits.outlier_density * work[OUTSIDE, h]
        evidence = outlier + (1.0 - limits.outlier_share) * work[LIKELIHOOD, h]
        share = outlier / evidence
        shape = int(tile[SHAPE, h])
        is_found = reading[FOUND, h] > 0.0
        for first in range(0, 3 * NOISES if shape == LASTING else NOISES, NOISES):
            shown = first if shape == LASTING else 2 * NOISES
            kept = 0.0
            for m in range(NOISES):
                likely = (1.0 - share) * work[SHARE + shown + m, h]
                likely += share * tile[NOISE + first + m, h]
                # A surprise opens the question of the noise again.
                likely += _REOPENED * share * (noises[shape, 1, m] - likely)
                work[SHOWN + m, h] = likely if likely > _GIVEN_UP else 0.0
                kept += work[SHOWN + m, h]
            for m in range(NOISES):
                likely = work[SHOWN + m, h] / kept
                row = NOISE + first + m
                tile[row, h] = likely if is_found else tile[row, h]
        tile[EVIDENCE, h] = evidence
        tile[OUTLIER, h] = share if is_found else 1.0


@inlined
def _narrow(tile: Array, work: Array) -> None:
    """Narrow the covariance; mix with what was before, by how likely the tip was an outlier."""
    lanes = tile.shape[1]
    for a in range(ERROR):
        for h in range(lanes):
            inside = 1.0 - tile[OUTLIER, h]
            for i in range(3):
                by = inside * work[NARROWING + i, h]
                work[SPREAD + i, h] = by * work[COVARIED + ERROR * i + a, h]
            work[SPREAD + 3, h] = inside * tile[OUTLIER, h] * work[CHANGE + a, h]
        for b in range(a + 1):
            row = PLACE[a, b]
            for h in range(lanes):
                tile[row, h] += work[SPREAD + 3, h] * work[CHANGE + b, h] - (
                    work[SPREAD, h] * work[COVARIED + b, h]
                    + work[SPREAD + 1, h] * work[COVARIED + ERROR + b, h]
                    + work[SPREAD + 2, h] * work[COVARIED + 2 * ERROR + b, h]
                )
    for k in range(ERROR):
        for h in range(lanes):
            work[CHANGE + k, h] *= 1.0 - tile[OUTLIER, h]


@inlined
def _apply(tile: Array, reading: Array, limits: Limits, work: Array) -> None:
    """Change the estimates; a torsion's size has turned the tip all along."""
    for h in range(tile.shape[1]):
        for k in range(3):
            tile[X + k, h] += work[CHANGE + k, h]
        # What was measured: the directions of the readings are a lower triangle with ones.
        x = reading[READ, h]
        y = reading[READ + 1, h] - reading[ALONG + 3, h] * x
        z = reading[READ + 2, h] - reading[ALONG + 6, h] * x - reading[ALONG + 7, h] * y
        inside = 1.0 - tile[OUTLIER, h]
        tile[REMAINDER, h] += inside * (x - tile[X, h] - tile[REMAINDER, h])
        tile[REMAINDER + 1, h] += inside * (y - tile[X + 1, h] - tile[REMAINDER + 1, h])
        tile[REMAINDER + 2, h] += inside * (z - tile[X + 2, h] - tile[REMAINDER + 2, h])
        kappa = tile[KAPPA, h] + work[CHANGE + E_KAPPA, h]
        tile[KAPPA, h] = min(max(kappa, limits.smallest_curvature), limits.largest_curvature)
        tile[SCALE, h] += work[CHANGE + E_SCALE, h]
        change, lag, play = work[CHANGE + E_SIZE, h], tile[LAG, h], tile[PLAY, h]
        has_lag, has_changed = lag > 0.0, change != 0.0
        new_lag = min(max(lag + change, limits.smallest_lag), limits.largest_lag)
        new_play = min(max(play + change, 0.0), limits.largest_play)
        turn = tile[PER_SIZE, h] * (new_lag - lag if has_lag else new_play - play)
        tip = tile[TIP_ANGLE, h] + turn
        tile[TIP_ANGLE, h] = tip if has_changed else tile[TIP_ANGLE, h]
        tile[LAG, h] = new_lag if has_changed and has_lag else lag
        tile[PLAY, h] = new_play if has_changed and not has_lag else play
        behind = tile[BEHIND_PLAY, h]
        tile[BEHIND_PLAY, h] = tip if has_changed and not has_lag else behind
    for h in range(tile.shape[1]):
        rotate(tile, h, work[E_TURN, h], work[E_TURN + 1, h], work[E_TURN + 2, h])


@inlined
def rotate(tile: Array, h: int, x: float, y: float, z: float) -> None:
    """Turn an orientation by a vector in `target_plane`, 1.5 rad at most: R <- exp(v^) R."""
    squared = x * x + y * y + z * z
    scale = _LARGEST_TURN / math.sqrt(max(squared, _LARGEST_TURN * _LARGEST_TURN))
    x, y, z = scale * x, scale * y, scale * z
    a, b, _ = rotation_factors(scale * scale * squared)
    for column in range(3):
        r0, r1, r2 = tile[R + column, h], tile[R + 3 + column, h], tile[R + 6 + column, h]
        across = x * r0 + y * r1 + z * r2
        # v x (v x r) = v (v r) - r v^2.
        square = scale * scale * squared
        tile[R + column, h] = r0 + a * (y * r2 - z * r1) + b * (x * across - square * r0)
        tile[R + 3 + column, h] = r1 + a * (z * r0 - x * r2) + b * (y * across - square * r1)
        tile[R + 6 + column, h] = r2 + a * (x * r1 - y * r0) + b * (z * across - square * r2)
