"""Prediction of a moving target from its observed positions.

Tissue drifts and breathes. Three models compete to explain the observed positions: a random walk
(the target may go anywhere, so it is expected where it was last observed), a drift, and a drift
with a period and its first overtone. Drift and period are linear in their coefficients, which have
Gaussian priors, so that evidence and prediction have closed forms (Bishop, Pattern Recognition and
Machine Learning, 2006, section 3.5). The prediction is the mean of the models, weighted by their
evidence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp, softmax

from needle_controller.model.arrays import Array

WINDOW = 20.0
"""Observations are kept for this long [s]."""
SHORTEST = 3.0
"""Duration of observation below which the target is expected where it was last observed [s]: half a
breath, before which a breath looks like a drift."""
_BEGINS = (WINDOW, 0.5 * WINDOW, 0.25 * WINDOW)
"""Equally likely times since the motion began; before, the target followed a random walk [s]."""
_DRIFT_STD = (0.1, 0.001)
"""Standard deviations of a drifting target's position [m] and speed [m/s] in each direction."""
_BREATH_STD = (0.1, 0.0001, 0.005, 0.005, 0.002, 0.002)
"""The same for a breathing target, and for cosine and sine of its period and overtone [m]."""
_SLOWEST, _FASTEST, _RATE_STEP = 0.08, 0.7, 0.004
"""Rates of breathing [Hz]."""
_EVERY = 5
"""Stride between the rates that are separate models, in addition to the likeliest rate."""
_OF_SAMPLING = 0.2
"""Fastest breathing as a share of the sampling rate: a faster overtone aliases."""
_SCATTER = (1e-4, 3e-4, 1e-3)
"""Equally likely standard deviations of the motion beyond drift and breathing [m]."""
_RATE_SCATTER = 1e-4
"""The same in the search for the likeliest rate [m]."""
_WALK = (1e-3, 3e-3, 1e-2)
"""Equally likely standard deviations of a random walk over 1 s [m]."""
_MOST_SAMPLES = 80
_TERMS = len(_BREATH_STD)


class TargetMotion:
    """The motion of one target, or of many that are observed at the same times.

    Times are seconds of any clock that all calls share.
    """

    def __init__(self) -> None:
        self._times: list[float] = []
        self._points: list[Array] = []
        self._models: tuple[Array, Array] | None = None

    @property
    def last(self) -> Array:
        """Last observed position, shape (..., 3) [m].

        Raises
        ------
        IndexError
            Nothing has been observed yet.
        """
        return self._points[-1]

    @property
    def last_time(self) -> float:
        """Time of the last observation [s]."""
        return self._times[-1]

    def observe(self, time: float, points: npt.ArrayLike) -> None:
        """Add an observation; a time not later than the last one discards all earlier observations.

        Parameters
        ----------
        time : float
            Time of the observation [s].
        points : array_like, shape (..., 3)
            Observed positions [m].
        """
        if self._times and time <= self._times[-1]:
            self._times.clear()
            self._points.clear()
        # Limit the number of samples in the window by replacing the last one.
        spacing = WINDOW / _MOST_SAMPLES
        if len(self._times) > 1 and time - self._times[-2] < spacing:
            del self._times[-1], self._points[-1]
        self._times.append(time)
        self._points.append(np.array(points, dtype=float))
        while self._times[0] < time - WINDOW:
            del self._times[0], self._points[0]
        self._models = None

    def at(self, time: npt.ArrayLike) -> Array:
        """Return the expected position of the target, shape (..., 3) [m].

        Parameters
        ----------
        time : array_like, shape (...)
            Time for each target [s].
        """
        shape = self.last.shape
        if self._models is None:
            points = np.reshape(self._points, (len(self._times), -1, 3))
            self._models = _models_of_all(np.array(self._times) - self.last_time, points)
        rates, coefficients = self._models
        ahead = np.broadcast_to(np.asarray(time, dtype=float) - self.last_time, shape[:-1])
        moved = np.einsum("hnt,hntc->nc", _terms(ahead.reshape(-1), rates), coefficients)
        return np.asarray(self.last + moved.reshape(shape))


def _models_of_all(since: Array, points: Array) -> tuple[Array, Array]:
    """Return rates (H, N) [Hz] and coefficients (H, N, T, 3), times the weight of each model.

    The targets were observed `since` (K,) [s] at points (K, N, 3) [m]. The random walk and targets
    at rest need no coefficients, since all positions are relative to the last one.
    """
    samples = np.moveaxis(points - points[-1], 0, 1)
    moving = np.any(samples != 0.0, axis=(1, 2))
    rates, coefficients = np.zeros((0, len(samples))), np.zeros((0, len(samples), _TERMS, 3))
    if -since[0] >= SHORTEST and np.any(moving):
        known = _weighted_models(since, samples[moving])
        rates, coefficients = (np.zeros((len(m), len(samples), *m.shape[2:])) for m in known)
        rates[:, moving], coefficients[:, moving] = known
    return rates, coefficients


def _weighted_models(since: Array, samples: Array) -> tuple[Array, Array]:
    """Return rates (H, N) and coefficients (H, N, T, 3) times weights, of samples (N, K, 3)."""
    walk = _walk_evidence(since, samples)
    evidence, rates, coefficients = [_log_mean(np.sum(walk, axis=2))[None]], [], []
    for begin in _BEGINS:
        inside = since >= -begin
        if begin < WINDOW and np.all(inside):
            continue
        before = _log_mean(np.sum(walk[:, :, ~inside], axis=2)) - math.log(len(_BEGINS))
        for rate, log, fitted in _models(since[inside], samples[:, inside]):
            evidence.append(before + log)
            rates.append(np.broadcast_to(rate, log.shape))
            coefficients.append(fitted)
    log = np.concatenate(evidence)
    weights = softmax(log, axis=0)
    return np.concatenate(rates), weights[1:, :, None, None] * np.concatenate(coefficients)


def _models(since: Array, samples: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield rates (H, 1 or N) [Hz], log evidence (H, N), coefficients (H, N, T, 3).

    Rest and drift come first, then breathing.
    """
    still = np.zeros((1, 1))
    for std in (_DRIFT_STD[:1], _DRIFT_STD):
        yield still, *_fit(since, still, samples, std)
    fastest = min(_FASTEST, _OF_SAMPLING * (len(since) - 1) / -since[0])
    rates = np.arange(_SLOWEST, fastest, _RATE_STEP)
    if len(rates) < 3:
        return
    some = rates[::_EVERY, None]
    log, fitted = _fit(since, some, samples, _BREATH_STD)
    yield some, log - math.log(len(some)), fitted
    likeliest = _likeliest_rates(since, samples, rates)[None]
    log, fitted = _fit(since, likeliest, samples, _BREATH_STD)
    yield likeliest, log - math.log(len(rates)), fitted


def _fit(since: Array, rates: Array, samples: Array, std: tuple[float, ...]) -> tuple[Array, Array]:
    """Return log evidence (H, N), coefficients (H, N, T, 3) of models of samples (N, K, 3).

    Terms X, prior N(0, S^2) of the coefficients and scatter s give the samples the covariance
    X S^2 X' + s^2, and the coefficients the mean S (S X'X S + s^2)^-1 S X'y. The eigenvalues of S
    X'X S are the same for every s. Rates have shape (H, 1), for all targets, or (H, N).
    """
    scale = np.array(std)
    scaled = _terms(since, rates[..., None])[..., : len(std)] * scale
    transposed = scaled.swapaxes(-1, -2)
    values, vectors = np.linalg.eigh(transposed @ scaled)
    projected = vectors.swapaxes(-1, -2) @ (transposed @ samples)
    square, count = np.sum(samples**2, axis=(1, 2)), len(since)
    logs, fits = [], []
    for variance in np.square(_SCATTER):
        sums = np.maximum(values, 0.0) + variance
        rest = square - np.sum(projected**2 / sums[..., None], axis=(-2, -1))
        determinant = np.sum(np.log(sums / variance), axis=-1) + count * math.log(variance)
        logs.append(-1.5 * (determinant + count * math.log(2.0 * math.pi)) - 0.5 * rest / variance)
        fits.append(scale[:, None] * (vectors @ (projected / sums[..., None])))
    log = np.stack(logs, axis=-1)
    coefficients = np.zeros((*log.shape[:2], _TERMS, 3))
    coefficients[:, :, : len(std)] = np.einsum(
        "hns,shntc->hntc", softmax(log, axis=-1), np.array(fits)
    )
    return _log_mean(log), coefficients


def _walk_evidence(since: Array, samples: Array) -> Array:
    """Return log densities of a random walk's steps, (N, S, K); the first is the position's."""
    variance = np.square(_WALK)[:, None] * np.diff(since)
    steps = np.sum(np.diff(samples, axis=1) ** 2, axis=2)[:, None]
    log = -1.5 * np.log(2.0 * math.pi * variance) - 0.5 * steps / variance
    place = -1.5 * math.log(2.0 * math.pi * _DRIFT_STD[0] ** 2)
    return np.concatenate([np.full((*log.shape[:2], 1), place), log], axis=2)


def _log_mean(logs: Array) -> Array:
    """Return the logarithm of the mean of the exponentials along the last axis."""
    return np.asarray(logsumexp(logs, axis=-1) - math.log(logs.shape[-1]))


def _likeliest_rates(since: Array, samples: Array, rates: Array) -> Array:
    """Return each target's likeliest rate, interpolated between the given rates, (N,) [Hz]."""
    # Append the prior as rows: each coefficient is observed as 0 with its standard deviation.
    scaled = _terms(since, rates[:, None]) * np.array(_BREATH_STD)
    prior = np.broadcast_to(_RATE_SCATTER * np.eye(_TERMS), (len(rates), _TERMS, _TERMS))
    q, r = np.linalg.qr(np.concatenate([scaled, prior], axis=1))
    q = q[:, : len(since)]
    explained = np.sum(np.einsum("fkt,nkc->nftc", q, samples, optimize=True) ** 2, axis=(2, 3))
    volume = np.sum(np.log(np.abs(np.diagonal(r, axis1=1, axis2=2))), axis=1)
    likely = explained - 6.0 * _RATE_SCATTER**2 * volume
    best, row = np.clip(np.argmax(likely, axis=1), 1, len(rates) - 2), np.arange(len(samples))
    before, at, after = (likely[row, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * at + after
    offset = np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, 1.0), 0.0)
    return np.asarray(rates[best] + _RATE_STEP * np.clip(offset, -1.0, 1.0))


def _terms(time: Array, rate: Array) -> Array:
    """Return the terms of a motion, (..., T): a position, a drift, a period and its overtone."""
    phase = 2.0 * np.pi * rate * time
    one = np.ones_like(phase)
    return np.stack(
        [one, time * one, np.cos(phase), np.sin(phase), np.cos(2.0 * phase), np.sin(2.0 * phase)],
        axis=-1,
    )
