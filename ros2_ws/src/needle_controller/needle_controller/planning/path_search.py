"""Search for a path: an evolution strategy optimizes its via points.

A path is a chain of legs (`legs`) over m via points to the target. MA-ES (H.-G. Beyer, B. Sendhoff,
"Simplify your covariance matrix adaptation evolution strategy", IEEE Trans. Evolutionary
Computation 21(5), 2017) minimizes its cost J (`path_evaluation`) over x, the 3 m coordinates of the
via points, with its default constants and without derivatives:

    z_k ~ N(0, I),  d_k = M z_k,  x_k = y + sigma d_k,  k = 1 .. lambda, sorted by cost
    y     <- y + sigma sum_k w_k d_k                                   k = 1 .. mu = lambda / 2
    s     <- (1 - c_s) s + sqrt(mu_w c_s (2 - c_s)) sum_k w_k z_k
    M     <- M (I + c_1 / 2 (s s' - I) + c_w / 2 (sum_k w_k z_k z_k' - I))
    sigma <- sigma exp(c_s / 2 (|s| / E|N(0, I)| - 1))

It finds narrow passages that random samples miss, because every candidate, even one that touches an
obstacle, indicates the direction of better ones. The draws z depend only on the number of the
start, so the same problem has the same solution.
"""

# Numba functions take positional arguments: keywords are slow or unsupported.
# ruff: noqa: PLR0917
from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.path_evaluation import PathEvaluation, PathProblem, evaluate_path
from needle_core.compiled import compiled

MOST_VIA_POINTS = 3
_Indices = npt.NDArray[np.int64]
QUICK_STARTS, THOROUGH_STARTS = 3, 250
"""Starts of the search at every step (about 10 ms), and before insertion if those fail (2 s)."""
_PATHS = 10
"""lambda, number of paths per generation of a quick start; other starts have twice as many and find
more per start (A. Auger, N. Hansen, "A restart CMA evolution strategy with increasing population
size", 2005)."""
_GENERATIONS = 60
_SPREAD, _LEAST_SPREAD = 0.004, 1e-5
"""Initial sigma, and sigma at which the search ends [m]."""
_SHORTEST_LEG = 0.01
"""Least length of a leg to a via point [m]: half a turn of the bevel takes 6 mm."""
_WIDTH = 0.03
"""Width of the tube around the straight line in which searches start [m]."""
_PLACES = 1.1127756842787055 ** -np.arange(1.0, 2 * MOST_VIA_POINTS + 1)
"""Steps of the R sequence in 6 dimensions (M. Roberts 2018), where g^7 = g + 1."""


def initial_legs(tip: Array, target: Array, number: int) -> tuple[Array, Array]:
    """Return the initial via points of one start of the search, and its draws.

    Parameters
    ----------
    tip, target : ndarray, shape (3,)
        Beginning and end of the path [m].
    number : int
        Number of the start, from 0 on.

    Returns
    -------
    legs : ndarray, shape (m + 1, 4)
        Aim of each leg, and inf. The via points divide the straight line evenly and lie off it
        [m].
    draws : ndarray, shape (generations, lambda, 3 m)
        See `optimize_legs`.
    """
    count = 1 + number % MOST_VIA_POINTS
    share = np.arange(1.0, count + 1.0)[:, np.newaxis] / (count + 1.0)
    points = tip + share * (target - tip)
    offsets = np.mod(0.5 + number * _PLACES[: 2 * count], 1.0) - 0.5
    points[:, :2] += 4.0 * share * (1.0 - share) * _WIDTH * offsets.reshape(-1, 2)
    legs = np.full((count + 1, 4), math.inf)
    legs[:count, :3], legs[count, :3] = points, target
    paths = _PATHS if number < QUICK_STARTS else 2 * _PATHS
    draws = np.random.default_rng(number).standard_normal((_GENERATIONS, paths, 3 * count))
    return legs, draws


@compiled
def optimize_legs(legs: Array, problem: PathProblem, draws: Array) -> PathEvaluation:
    """Optimize the via points of a path; return its evaluation.

    Parameters
    ----------
    legs : ndarray, shape (m + 1, 4), changed
        Aim and length of each leg [m], which become those of the best path found.
    problem : PathProblem
        Task of the path.
    draws : ndarray, shape (generations, lambda, 3 m)
        z: standard normal numbers.
    """
    generations, paths, size = draws.shape
    rates = _rates(size, paths // 2)
    mean, path, matrix, sigma = np.empty(size), np.zeros(size), np.eye(size), _SPREAD
    for i in range(size):
        mean[i] = legs[i // 3, i % 3]
    d, costs, order = np.empty((paths, size)), np.empty(paths), np.empty(paths, np.int64)
    candidate = legs.copy()
    best = evaluate_path(legs, problem, _SHORTEST_LEG)
    for generation in range(generations):
        z = draws[generation]
        for k in range(paths):
            _multiply(matrix, z[k], d[k])
            for i in range(size):
                candidate[i // 3, i % 3] = mean[i] + sigma * d[k, i]
            candidate[:, 3] = math.inf
            assessed = evaluate_path(candidate, problem, _SHORTEST_LEG)
            costs[k] = assessed.cost
            if assessed.cost < best.cost:
                best = assessed
                for i in range(4 * legs.shape[0]):
                    legs[i // 4, i % 4] = candidate[i // 4, i % 4]
            rank = k
            while rank > 0 and costs[order[rank - 1]] > costs[k]:
                order[rank] = order[rank - 1]
                rank -= 1
            order[rank] = k
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
    """Update y, s and M from the best paths of a generation; return the factor of sigma."""
    size, c_s, c_1, c_w = path.size, rates.c_s, rates.c_1, rates.c_w
    gain, squared = math.sqrt(rates.effective * c_s * (2.0 - c_s)), 0.0
    for i in range(size):
        path[i] *= 1.0 - c_s
        for k in range(rates.weights.size):
            mean[i] += sigma * rates.weights[k] * d[order[k], i]
            path[i] += gain * rates.weights[k] * z[order[k], i]
        squared += path[i] * path[i]
    # M times the bracket: M s is computed first, M z is d.
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
    """Compute a product without BLAS, whose order of summation differs between machines."""
    for i in range(vector.size):
        product[i] = 0.0
        for j in range(vector.size):
            product[i] += matrix[i, j] * vector[j]
