"""The insertion at the moment of an exposure, between the joint states around it."""

from __future__ import annotations

import math
from collections import deque

_KEPT = 2000


class InsertionHistory:
    """Insertions with their stamps, to interpolate in."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._first = 0
        self.refused = 0
        self.restarts = 0

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, stamp: int, insertion: float) -> None:
        """Take a sample.

        Parameters
        ----------
        stamp : int
            Time of sampling [ns]. One that runs backwards starts the history afresh.
        insertion : float
            Insertion [m]; one that is not finite is counted and not used.
        """
        if not math.isfinite(insertion):
            self.refused += 1
            return
        if self._samples and stamp < self._samples[-1][0]:
            self._samples.clear()
            self.restarts += 1
        elif self._samples and stamp == self._samples[-1][0]:
            self._samples.pop()
        if not self._samples:
            self._first = stamp
        self._samples.append((stamp, insertion))

    def time_before(self, stamp: int) -> int:
        """Return how long before the history began `stamp` is [ns]; 0 after it, or if it is empty.

        The history begins with its first sample, whether that is still kept or not.
        """
        return max(0, self._first - stamp) if self._samples else 0

    def is_bracketed(self, stamp: int) -> bool:
        """Return whether a sample at or after `stamp` [ns] has come: no later one can matter."""
        return bool(self._samples) and self._samples[-1][0] >= stamp

    def at(self, stamp: int) -> float | None:
        """Return the insertion [m] at `stamp` [ns], interpolated; None outside of the samples."""
        after: tuple[int, float] | None = None
        for sample in reversed(self._samples):
            if sample[0] == stamp:
                return sample[1]
            if sample[0] < stamp:
                if after is None:
                    return None
                share = (stamp - sample[0]) / (after[0] - sample[0])
                return sample[1] + share * (after[1] - sample[1])
            after = sample
        return None
