"""How far tips lie short of the insertion over the first centimetres.

The filter cannot tell a tip that is late from a needle that is not there yet: it goes on from where
the tips are, and the true needle is ahead of that by as much as the stage has moved since they were
exposed. What shows is that as much is missing from the first millimetres on, and no more later.
"""

from __future__ import annotations

import numpy as np

from needle_controller.model.arrays import Array

FIRST, LAST = 0.004, 0.020
"""Insertion between which tips are asked: beyond, a needle bends, or slips, too much [m]."""
_LEAST_TIPS = 5


class Shortfall:
    """What of the insertion since the first tip the tips do not show, of many needles.

    Parameters
    ----------
    start : ndarray, shape (N, 3)
        The first tips [m]; NaN where there was none: nothing is said of these.
    """

    def __init__(self, start: Array) -> None:
        self._start = start.copy()
        self._inserted = np.zeros(len(start))
        self._missing = np.zeros(len(start))
        self._tips = np.zeros(len(start))

    def advance(self, length: Array) -> None:
        """Take what was inserted, (N,) [m]."""
        self._inserted += length

    def see(self, tip: Array, age: Array) -> None:
        """Take tips, (N, 3) [m], NaN where there is none, and what was inserted since, (N,) [m]."""
        inserted = self._inserted - age
        missing = inserted - np.linalg.norm(tip - self._start, axis=1)
        counts = (inserted >= FIRST) & (inserted <= LAST) & np.isfinite(missing)
        self._missing += np.where(counts, missing, 0.0)
        self._tips += counts

    def mean(self) -> Array:
        """Return the mean of what is missing, (N,) [m]; 0 before there is enough to tell."""
        told = self._tips >= _LEAST_TIPS
        return np.where(told, self._missing / np.maximum(self._tips, 1.0), 0.0)

    def change_frame(self, T_new_old: Array) -> None:  # noqa: N803
        """Express the start in another frame, (4, 4)."""
        self._start = self._start @ T_new_old[:3, :3].T + T_new_old[:3, 3]
