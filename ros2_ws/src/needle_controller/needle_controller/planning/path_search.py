"""The search for a path: via points, moved by an evolution strategy until their path is good.

A path is a chain of legs (`legs`) over m via points, the last to the target. For x, the 3 m
coordinates of the via points, its cost J (`clearance`) says how good it is; MA-ES (H.-G. Beyer, B.
Sendhoff, "Simplify your covariance matrix adaptation evolution strategy", IEEE Trans. Evolutionary
Computation 21(5), 2017) minimises that, with its own constants and without derivatives:

    z_k ~ N(0, I),  d_k = M z_k,  x_k = y + sigma d_k,  k = 1 .. lambda, sorted by cost
    y     <- y + sigma sum_k w_k d_k                                   k = 1 .. mu = lambda / 2
    s     <- (1 - c_s) s + sqrt(mu_w c_s (2 - c_s)) sum_k w_k z_k
    M     <- M (I + c_1 / 2 (s s' - I) + c_w / 2 (sum_k w_k z_k z_k' - I))
    sigma <- sigma exp(c_s / 2 (|s| / E|N(0, I)| - 1))

It finds the narrow ways that points strewn beforehand miss, since every path that was tried, also
one that touches something, says where better ones lie. The draws z depend on the start's number
alone: the same question has the same answer.
"""

# Compiled code takes keywords slowly or not at all.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.clearance import Assessment, assess
from needle_controller.planning.path_settings import Question
from needle_core.compiled import compiled

MOST_VIA_POINTS = 3
_Indices = npt.NDArray[np.int64]
QUICK_STARTS, THOROUGH_STARTS = 3, 250
"""Starts of the search on the way, and before insertion where those find nothing: about 10 ms and 2
s of one core."""
_PATHS = 10
"""lambda, paths of a generation, of a quick start; the others have twice as many, which find more
per start (A. Auger, N. Hansen, "A restart CMA evolution strategy with increasing population size",
2005)."""
_GENERATIONS = 60
_SPREAD, _LEAST_SPREAD = 0.004, 1e-5
"""sigma at the start, and below which via points no longer matter [m]."""
_SHORTEST_LEG = 0.01
"""To a via point [m]: the bevel's half turn takes 6 mm, and nearer points are aimed at badly."""
_WIDTH = 0.03
"""Of the tube around the straight way in which searches start [m]: the widest obstacle's and more.
"""
_PLACES = 1.1127756842787055 ** -np.arange(1.0, 2 * MOST_VIA_POINTS + 1)
"""Steps of the R sequence in 6 dimensions (M. Roberts 2018), of which g^7 = g + 1."""


def first_guess(tip: Array, target: Array, number: int) -> tuple[Array, Array]:
    """Return where one start of the search begins, and its draws.

    Parameters
    ----------
    tip, target : ndarray, shape (3,)
        Where from and where to [m].
    number : int
        Of the start, from 0 on.

    Returns
    -------
    legs : ndarray, shape (m + 1, 4)
        What each is steered towards, and inf. The via points divide the straight way evenly and lie
        aside of it [m].
    draws : ndarray, shape (generations, lambda, 3 m)
        See `improve`.
    """
    count = 1 + number % MOST_VIA_POINTS
    share = np.arange(1.0, count + 1.0)[:, np.newaxis] / (count + 1.0)
    points = tip + share * (target - tip)
    aside = np.mod(0.5 + number * _PLACES[: 2 * count], 1.0) - 0.5
    points[:, :2] += 4.0 * share * (1.0 - share) * _WIDTH * aside.reshape(-1, 2)
    legs = np.full((count + 1, 4), math.inf)
    legs[:count, :3], legs[count, :3] = points, target
    paths = _PATHS if number < QUICK_STARTS else 2 * _PATHS
    draws = np.random.default_rng(number).standard_normal((_GENERATIONS, paths, 3 * count))
    return legs, draws


@compiled
def improve(legs: Array, question: Question, draws: Array) -> Assessment:
    """Move via points until their path is good; return what is to be said of it.

    Parameters
    ----------
    legs : ndarray, shape (m + 1, 4)
        Of each leg what it is steered towards, and its length [m]; the via points are the best
        that were found, and the lengths those of their path: written.
    question : Question
        What is wanted of the path.
    draws : ndarray, shape (generations, lambda, 3 m)
        z: normal numbers.
    """
    generations, paths, size = draws.shape
    rates = _rates(size, paths // 2)
    mean, path, matrix, sigma = np.empty(size), np.zeros(size), np.eye(size), _SPREAD
    for i in range(size):
        mean[i] = legs[i // 3, i % 3]
    d, costs, order = np.empty((paths, size)), np.empty(paths), np.empty(paths, np.int64)
    tried = legs.copy()
    best = assess(legs, question, _SHORTEST_LEG)
    for generation in range(generations):
        z = draws[generation]
        for k in range(paths):
            _multiply(matrix, z[k], d[k])
            for i in range(size):
                tried[i // 3, i % 3] = mean[i] + sigma * d[k, i]
            tried[:, 3] = math.inf
            assessed = assess(tried, question, _SHORTEST_LEG)
            costs[k] = assessed.cost
            if assessed.cost < best.cost:
                best = assessed
                legs[:] = tried
            place = k
            while place > 0 and costs[order[place - 1]] > costs[k]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = k
        sigma *= _adapt(z, d, order, sigma, rates, mean, path, matrix)
        if sigma < _LEAST_SPREAD:
            break
    return best


class _Rates(NamedTuple):
    """Constants of MA-ES: w_k, mu_w, c_s, c_1, c_w and E|N(0, I)|."""

    weights: Array
    effective: float
    c_s: float
    c_1: float
    c_w: float
    expected: float


@compiled
def _rates(size: int, parents: int) -> _Rates:
    weights = np.log(parents + 0.5) - np.log(np.arange(1.0, parents + 1.0))
    weights /= weights.sum()
    effective = 1.0 / (weights * weights).sum()
    c_1 = 2.0 / ((size + 1.3) ** 2 + effective)
    c_w = 2.0 * (effective + 1.0 / effective - 2.0) / ((size + 2.0) ** 2 + effective)
    return _Rates(
        weights,
        effective,
        (effective + 2.0) / (size + effective + 5.0),
        c_1,
        min(1.0 - c_1, c_w),
        math.sqrt(size) * (1.0 - 0.25 / size + 1.0 / (21.0 * size * size)),
    )


@compiled
def _adapt(
    z: Array,
    d: Array,
    order: _Indices,
    sigma: float,
    rates: _Rates,
    mean: Array,
    path: Array,
    matrix: Array,
) -> float:
    """Update y, s and M, of the best paths of a generation; return the factor of sigma."""
    size, c_s, c_1, c_w = path.size, rates.c_s, rates.c_1, rates.c_w
    gain, squared = math.sqrt(rates.effective * c_s * (2.0 - c_s)), 0.0
    for i in range(size):
        path[i] *= 1.0 - c_s
        for k in range(rates.weights.size):
            mean[i] += sigma * rates.weights[k] * d[order[k], i]
            path[i] += gain * rates.weights[k] * z[order[k], i]
        squared += path[i] * path[i]
    # M times the bracket: M s is made first, M z is d.
    turned = np.empty(size)
    _multiply(matrix, path, turned)
    for i in range(size):
        for j in range(size):
            change = c_1 * turned[i] * path[j] - (c_1 + c_w) * matrix[i, j]
            for k in range(rates.weights.size):
                change += c_w * rates.weights[k] * d[order[k], i] * z[order[k], j]
            matrix[i, j] += 0.5 * change
    return math.exp(min(0.5 * c_s * (math.sqrt(squared) / rates.expected - 1.0), 1.0))


@compiled
def _multiply(matrix: Array, vector: Array, product: Array) -> None:
    """Write a product, without BLAS: its sums' order is not the same everywhere."""
    for i in range(vector.size):
        product[i] = 0.0
        for j in range(vector.size):
            product[i] += matrix[i, j] * vector[j]
