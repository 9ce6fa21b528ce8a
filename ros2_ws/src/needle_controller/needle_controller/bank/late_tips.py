"""Tips that come late without saying so: told from the first centimetres, and taken as such.

A filter that is not told of it goes on from where the needle was, and takes each turn of the base
for one that the tip follows late. What shows is that as much of the insertion is missing from the
first millimetres on, and no more later: a needle that slips loses more the farther it goes.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.bank.hypothesis_mixture import MixtureEstimate
from needle_controller.model.arrays import Array

FIRST, LAST = 0.004, 0.020
"""Insertion since the start between which tips are asked: beyond, a needle bends too much [m]."""
LATE = "tips lie short of the insertion from the start: late, or the needle stuck; taken as late"
_LEAST_TIPS = 5
_SURE = 3.0
_OUTLIER = 4.0


class _Advance(NamedTuple):
    length: Array
    turn: Array


class _Look(NamedTuple):
    inserted: Array
    tip: Array
    covariance: Array | None
    age: Array


class LateTips:
    """A hypothesis filter whose tips may be older than they say; see `estimator.Estimator`.

    Over the first `LAST` what happens is kept. If the tips are late then, all of it happens once
    more with tips of that age, and so does all that follows.

    Parameters
    ----------
    estimator : HypothesisFilter
        What takes the tips.
    entry : array_like, shape (3,), optional
        Where the needle enters, in `target_plane` [m]: where its tip is with the stage at 0, along
        the needle to within `FilterSettings.entry_std`. Not known if none is given.
    """

    def __init__(self, estimator: HypothesisFilter, entry: npt.ArrayLike | None = None) -> None:
        self._estimator = estimator
        self._entry = None if entry is None else np.asarray(entry, dtype=float)
        self.reset(np.zeros(3), np.zeros(2))

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        self._start, self._joints = np.asarray(tip, dtype=float), np.asarray(joints, dtype=float)
        self._inserted = np.zeros(self._start.shape[:-1])
        self._late = np.zeros(self._start.shape[:-1])
        self._log: list[_Advance | _Look] | None = []
        self._estimator.reset(self._start, self._joints)

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        step = _Advance(np.asarray(d_insertion, dtype=float), np.asarray(d_rotation, dtype=float))
        self._estimator.advance(*step)
        self._inserted = self._inserted + step.length
        if self._log is not None:
            self._log.append(step)

    def correct(
        self, tip: npt.ArrayLike, covariance: npt.ArrayLike | None = None, age: npt.ArrayLike = 0.0
    ) -> None:
        """Take a measurement; see `Estimator.correct`."""
        known = None if covariance is None else np.asarray(covariance, dtype=float)
        look = _Look(self._inserted, np.asarray(tip, dtype=float), known, np.asarray(age))
        self._take(look)
        if self._log is not None:
            self._log.append(look)
            if np.all(self._inserted >= LAST):
                self._decide(self._log)
                self._log = None

    def estimate(self) -> MixtureEstimate:
        """Return what is known now; see `Estimator.estimate`."""
        estimate, late = self._estimator.estimate(), self._late > 0.0
        if not np.any(late):
            return estimate
        return dataclasses.replace(
            estimate, doubtful=np.asarray(estimate.doubtful) | late, doubts=(*estimate.doubts, LATE)
        )

    def change_frame(self, T_new_old: npt.ArrayLike) -> None:  # noqa: N803
        """Express everything in another target plane; see `Estimator.change_frame`."""
        transform = np.asarray(T_new_old, dtype=float)
        turn, offset = transform[:3, :3], transform[:3, 3]
        self._estimator.change_frame(transform)
        self._start = self._start @ turn.T + offset
        if self._entry is not None:
            self._entry = turn @ self._entry + offset
        for k, event in enumerate(self._log or []):
            if isinstance(event, _Look) and self._log is not None:
                known = None if event.covariance is None else turn @ event.covariance @ turn.T
                tip = event.tip @ turn.T + offset
                self._log[k] = event._replace(tip=tip, covariance=known)

    def _take(self, look: _Look) -> None:
        self._estimator.correct(look.tip, look.covariance, look.age + self._late)

    def _decide(self, log: list[_Advance | _Look]) -> None:
        """Say how late the tips are; if they are, take all of them again."""
        looks = [event for event in log if isinstance(event, _Look)]
        settings = self._estimator.settings
        too_deep, entry_std = np.zeros(()), np.inf
        if self._entry is not None and np.all(self._joints[..., 0] <= FIRST):
            heading = self._estimator.initial_rotation[:, 2]
            too_deep = (self._start - self._entry) @ heading - self._joints[..., 0]
            entry_std = settings.entry_std
        self._late = untold_age(
            np.stack([look.inserted - look.age for look in looks]),
            np.stack([look.tip - self._start for look in looks]),
            too_deep,
            entry_std=entry_std,
            bound=settings.believed_bound,
            scale_spread=settings.scale_spread,
        )
        if not np.any(self._late):
            return
        self._estimator.reset(self._start, self._joints)
        for event in log:
            if isinstance(event, _Look):
                self._take(event)
            else:
                self._estimator.advance(*event)


def untold_age(
    inserted: Array,
    ways: Array,
    too_deep: Array,
    *,
    entry_std: float,
    bound: float,
    scale_spread: float,
) -> Array:
    """Return how old tips are that say they are new, in insertion [m].

    A straight line through what the tips do not show of the insertion: its slope is slip, and what
    it begins with is age, beside the error of the first tip.

    Parameters
    ----------
    inserted : ndarray, shape (K, ...)
        Since the first tip, at each one's exposure as it says [m].
    ways : ndarray, shape (K, ..., 3)
        From the first tip to each of them [m]; NaN where there is none.
    too_deep : ndarray, shape (...)
        How far the first tip was beyond where the needle is known to enter [m].
    entry_std : float
        How well that is known [m]; infinite if not at all.
    bound : float
        Largest error claimed of a coordinate [m].
    scale_spread : float
        Standard deviation of the insertion scale.

    Returns
    -------
    ndarray, shape (...)
        0 where it is not sure that they are late.
    """
    least = bound**2 / 3.0
    # Noise across the way makes it longer: two coordinates of both tips.
    inserted = np.broadcast_to(inserted, ways.shape[:-1])
    length = np.sqrt(np.maximum(np.sum(ways**2, axis=-1) - 4.0 * least, 0.0))
    asked = (inserted >= FIRST) & (inserted <= LAST + 1e-9) & np.isfinite(length)
    enough = np.sum(asked, axis=0) >= _LEAST_TIPS
    missing = np.where(asked & enough, inserted - length, np.where(enough, np.nan, 0.0))
    off = np.abs(missing - np.nanmedian(missing, axis=0))
    counts = off <= np.maximum(_OUTLIER * np.nanmedian(off, axis=0), bound)
    number = np.sum(counts, axis=0)
    middle = np.mean(inserted, axis=0, where=counts)
    mean = np.mean(missing, axis=0, where=counts)
    along = np.where(counts, inserted - middle, 0.0)
    across = np.where(counts, missing - mean, 0.0)
    noise = np.maximum(np.sum(across**2, axis=0) / number, least)
    slip_variance = 1.0 / (np.sum(along**2, axis=0) / noise + scale_spread**-2.0)
    slip = slip_variance * np.sum(along * across, axis=0) / noise
    of_entry = noise / (noise + entry_std**2)
    age = mean - slip * middle - of_entry * too_deep
    start_variance = noise * (1.0 - of_entry)
    std = np.sqrt(start_variance + noise / number + slip_variance * middle**2)
    return np.where(enough & (age > _SURE * std), age, 0.0)
