"""Prediction of a moving target, some seconds ahead, from where it was seen.

Tissue drifts, and breathes: what was seen of a target is explained by a drift, or by a drift and a
period with its first overtone, whichever is simpler and explains it. What neither explains is not
foretold: the target is then expected to stay where it was last seen. Nothing is asked of phase,
rate or direction, and a target that was seen once, or rests, is where it is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array

WINDOWS = (20.0, 10.0)
"""So far back is asked what was seen: the shorter where the longer is not of one piece, as after a
jump [s]."""
SHORTEST = 5.0
"""So long a target must have been seen: less tells no drift from a breath [s]."""
SLOWEST, FASTEST = 0.08, 0.7
"""Rates of breathing that are thought of [Hz]."""
EXPLAINED = 0.9
"""Share of the variance that an explanation must explain."""
_BETTER = 0.25
"""Share of the variance that a drift leaves, at which a period explains better."""
_RECENT = 2.0
"""So long is averaged for where an explained target is: jumps pass soon, and noise is small [s]."""
_GOES_ON = 2.0
"""A drift goes on for so many times as long as it was seen, and a target no farther beyond where it
was seen, in each direction, than so many times as far as it was seen to move."""
_RATE_STEP = 0.004
_OF_SAMPLING = 0.2
"""Fastest breathing as a share of the sampling's rate: its overtone is told from a slower one."""
_MOST_SAMPLES = 80
_TERMS = 6
_DRIFT = 2  # the first terms
_AT_REST = 1e-12  # variance [m^2]


class TargetMotion:
    """The motion of one target, or of many that are seen at the same times.

    Times are seconds of any clock that all calls share.
    """

    def __init__(self) -> None:
        self._times: list[float] = []
        self._points: list[Array] = []
        self._motion: _Motion | None = None

    @property
    def last(self) -> Array:
        """Place where it was last seen, shape (..., 3) [m].

        Raises
        ------
        IndexError
            Nothing was seen yet.
        """
        return self._points[-1]

    @property
    def seen(self) -> float:
        """Time at which it was last seen [s]."""
        return self._times[-1]

    def see(self, time: float, points: npt.ArrayLike) -> None:
        """Take where the target is; a time that is not after the last begins anew.

        Parameters
        ----------
        time : float
            When it was there [s].
        points : array_like, shape (..., 3)
            Where [m].
        """
        if self._times and time <= self._times[-1]:
            self.forget()
        # Not more often than the window needs: the last one may still be replaced.
        spacing = WINDOWS[0] / _MOST_SAMPLES
        if len(self._times) > 1 and time - self._times[-2] < spacing:
            del self._times[-1], self._points[-1]
        self._times.append(time)
        self._points.append(np.array(points, dtype=float))
        while self._times[0] < time - WINDOWS[0]:
            del self._times[0], self._points[0]
        self._motion = None

    def forget(self) -> None:
        """Forget all that was seen."""
        self._times.clear()
        self._points.clear()
        self._motion = None

    def at(self, time: npt.ArrayLike) -> Array:
        """Return where the target is expected, shape (..., 3) [m].

        Parameters
        ----------
        time : array_like, shape (...)
            When, for each target [s].
        """
        if self._motion is None:
            self._motion = _Motion(np.array(self._times), np.array(self._points))
        return self._motion.at(np.asarray(time, dtype=float))


class _Motion:
    """Motion that explains some targets' samples: times (K,) [s], points (K, ..., 3) [m]."""

    def __init__(self, times: Array, points: Array) -> None:
        self._shape = points.shape[1:-1]
        self._end = times[-1]
        self._span = times[-1] - times[0]
        since, samples = times - self._end, points.reshape(len(times), -1, 3)
        self._rates = np.zeros(samples.shape[1])
        self._coefficients = np.zeros((samples.shape[1], _TERMS, 3))
        least, most = samples.min(axis=0), samples.max(axis=0)
        beyond = _GOES_ON * (most - least)
        self._bounds = least - beyond, most + beyond
        self._place = samples[-1].copy()
        unexplained = np.arange(samples.shape[1])
        for window in WINDOWS:
            inside = since >= -window
            seen = np.moveaxis(samples[inside][:, unexplained], 0, 1)
            rates, coefficients, explained = _explain(since[inside], seen)
            self._rates[unexplained] = rates
            self._coefficients[unexplained] = coefficients
            unexplained = unexplained[~explained]
        recent = since[since >= -_RECENT]
        moved = np.stack([self._moved(np.full_like(self._rates, t)) for t in recent])
        self._place += np.where(
            np.any(self._coefficients, axis=(1, 2))[:, None],
            np.mean(samples[-len(recent) :] - moved, axis=0) - samples[-1],
            0.0,
        )

    def at(self, time: Array) -> Array:
        """Return where the targets are expected [m]."""
        ahead = np.broadcast_to(time - self._end, self._shape).reshape(-1)
        place = np.clip(self._place + self._moved(ahead), *self._bounds)
        return np.asarray(place.reshape(*self._shape, 3))

    def _moved(self, ahead: Array) -> Array:
        """Return how far the targets move from the last sample until some time after it [m]."""
        terms = _terms(ahead, self._rates) - _terms(np.zeros_like(ahead), self._rates)
        terms[:, 1] = np.clip(terms[:, 1], -_GOES_ON * self._span, _GOES_ON * self._span)
        return np.asarray(np.einsum("nt,ntc->nc", terms, self._coefficients))


def _explain(times: Array, samples: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Return rates (N,), coefficients (N, T, 3) of the terms, and which targets they explain.

    Coefficients of what is not explained are 0.
    """
    needles, count, _ = samples.shape
    rates, coefficients = np.zeros(needles), np.zeros((needles, _TERMS, 3))
    span = -times[0]
    if span < SHORTEST or count <= _TERMS:
        return rates, coefficients, np.zeros(needles, dtype=bool)
    variance = _variance(samples - samples.mean(axis=1, keepdims=True), 1)
    if np.all(variance <= _AT_REST):
        return rates, coefficients, np.ones(needles, dtype=bool)
    drift = _terms(times, np.zeros(1))[:, :_DRIFT]
    solved, *_ = np.linalg.lstsq(drift, np.moveaxis(samples, 1, 0).reshape(count, -1), rcond=None)
    coefficients[:, :_DRIFT] = np.moveaxis(solved.reshape(_DRIFT, needles, 3), 1, 0)
    left = _variance(samples - drift @ coefficients[:, :_DRIFT], _DRIFT)
    fastest = min(FASTEST, _OF_SAMPLING * (count - 1) / span)
    thought_of = np.arange(max(SLOWEST, 1.0 / span), fastest, _RATE_STEP)
    if len(thought_of):
        found = _likeliest_rates(times, samples, thought_of)
        design = _terms(times[None, :], found[:, None])
        q, r = np.linalg.qr(design)
        periodic = np.linalg.solve(r, q.swapaxes(1, 2) @ samples)
        left_then = _variance(samples - design @ periodic, _TERMS)
        better = left_then < _BETTER * left
        rates[better], coefficients[better], left[better] = (
            found[better], periodic[better], left_then[better]
        )  # fmt: skip
    explained = (left <= (1.0 - EXPLAINED) * variance) & (variance > _AT_REST)
    coefficients[~explained] = 0.0
    return rates, coefficients, explained | (variance <= _AT_REST)


def _likeliest_rates(times: Array, samples: Array, rates: Array) -> Array:
    """Return for each target the rate that leaves least, (N,) [Hz]; between those given, too."""
    q, _ = np.linalg.qr(_terms(times[None, :], rates[:, None]))
    explained = np.sum(np.einsum("fkt,nkc->nftc", q, samples) ** 2, axis=(2, 3))
    best = np.argmax(explained, axis=1)
    inner = np.clip(best, 1, max(len(rates) - 2, 1))
    if len(rates) < 3:
        return np.asarray(rates[best])
    row = np.arange(len(samples))
    before, at, after = (explained[row, inner + k] for k in (-1, 0, 1))
    bend = before - 2.0 * at + after
    offset = np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, 1.0), 0.0)
    return np.asarray(rates[inner] + _RATE_STEP * np.clip(offset, -1.0, 1.0))


def _terms(time: Array, rate: Array) -> Array:
    """Return the terms of a motion, (..., T): a place, a drift, a period and its overtone."""
    phase = 2.0 * np.pi * rate * time
    one = np.ones_like(phase)
    return np.stack(
        [one, time * one, np.cos(phase), np.sin(phase), np.cos(2.0 * phase), np.sin(2.0 * phase)],
        axis=-1,
    )


def _variance(rest: Array, terms: int) -> Array:
    """Return each target's mean square of what some terms leave, (N,) [m^2]."""
    return np.asarray(np.sum(rest**2, axis=(1, 2)) / (3 * (rest.shape[1] - terms)))
