"""Matching by stamps: left and right images of one exposure, and the insertion at it."""

from __future__ import annotations

import dataclasses
import math
import statistics
from collections import Counter, OrderedDict, deque
from typing import Generic, TypeVar

T = TypeVar("T")

_WAITING_LIMIT = 3  # images of one side without a partner
_SKEWS = 100  # number of latest pairs whose stamps are compared
_PERIODS = 15  # latest periods of the cameras, of which the median is used
_KEPT = 2000  # samples: 40 s at 50 Hz
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclasses.dataclass(frozen=True)
class Pair(Generic[T]):
    """Two images of one exposure; `stamp` [ns] is that of the left one."""

    stamp: int
    left: T
    right: T


class PairMatcher(Generic[T]):
    """Pairs images by stamp, never just the latest with the latest.

    An image waits for its partner until a later pair is complete or too many images wait.

    Parameters
    ----------
    tolerance : int or None
        Largest difference of the stamps of a pair [ns]; 0 for cameras on one trigger. None for
        free-running cameras: half the measured period of the cameras.

    Attributes
    ----------
    pairs : int
        Number of pairs.
    unpaired : Counter of str
        Number of images of each side that were dropped without a partner.
    """

    def __init__(self, tolerance: int | None) -> None:
        self._tolerance = tolerance
        self._last: dict[str, int] = {}
        self._periods: deque[int] = deque(maxlen=_PERIODS)
        self._skews: deque[int] = deque(maxlen=_SKEWS)
        self._waiting: dict[str, OrderedDict[int, T]] = {s: OrderedDict() for s in OTHER_SIDE}
        self.pairs, self.unpaired = 0, Counter[str]()

    @property
    def tolerance(self) -> int:
        """Largest difference of the stamps of a pair, as given or measured [ns]."""
        if self._tolerance is not None:
            return self._tolerance
        return round(statistics.median(self._periods) / 2.0) if self._periods else 0

    @property
    def skew(self) -> tuple[float, int] | None:
        """Median and largest difference of the stamps of the latest pairs [ns], if any."""
        return (statistics.median(self._skews), max(self._skews)) if self._skews else None

    def add(self, side: str, stamp: int, image: T) -> Pair[T] | None:
        """Add an image; return the pair that it completes, if any.

        Parameters
        ----------
        side : str
            "left" or "right".
        stamp : int
            Time of exposure [ns].
        image : T
            The image.

        Returns
        -------
        Pair or None
            The completed pair.
        """
        if side in self._last:
            self._periods.append(abs(stamp - self._last[side]))
        self._last[side] = stamp
        others = self._waiting[OTHER_SIDE[side]]
        partner = min(others, key=lambda other: (abs(other - stamp), other), default=None)
        if partner is None or abs(partner - stamp) > self.tolerance:
            waiting = self._waiting[side]
            if waiting.pop(stamp, None) is not None:
                self.unpaired[side] += 1
            waiting[stamp] = image
            if len(waiting) > _WAITING_LIMIT:
                waiting.popitem(last=False)
                self.unpaired[side] += 1
            return None
        other_image = others.pop(partner)
        self._drop_older(OTHER_SIDE[side], partner)
        self._drop_older(side, stamp)
        self.pairs += 1
        self._skews.append(abs(partner - stamp))
        if side == "left":
            return Pair(stamp, image, other_image)
        return Pair(partner, other_image, image)

    def waiting(self, side: str) -> list[int]:
        """Return the stamps [ns] of the images of a side that wait for their partner."""
        return list(self._waiting[side])

    def _drop_older(self, side: str, stamp: int) -> None:
        waiting = self._waiting[side]
        for old in [other for other in waiting if other < stamp]:
            del waiting[old]
            self.unpaired[side] += 1


class InsertionHistory:
    """Insertions by stamp, for interpolation.

    Attributes
    ----------
    rejected : int
        Number of samples that were not finite.
    restarts : int
        Number of times that the stamps ran backwards.
    """

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._first = 0
        self.rejected = 0
        self.restarts = 0

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, stamp: int, insertion: float) -> None:
        """Add a sample.

        Parameters
        ----------
        stamp : int
            Time of sampling [ns]. A step backwards restarts the history.
        insertion : float
            Insertion [m]; only finite values are used.
        """
        if not math.isfinite(insertion):
            self.rejected += 1
            return
        if self._samples and stamp < self._samples[-1][0]:
            self._samples.clear()
            self.restarts += 1
        elif self._samples and stamp == self._samples[-1][0]:
            self._samples.pop()
        if not self._samples:
            self._first = stamp
        self._samples.append((stamp, insertion))

    @property
    def latest(self) -> int:
        """Stamp of the last sample, up to which `at` is final [ns]; -1 without any."""
        return self._samples[-1][0] if self._samples else -1

    def time_before(self, stamp: int) -> int:
        """Return the time from `stamp` to the first sample ever [ns]; 0 if that was before."""
        return max(0, self._first - stamp) if self._samples else 0

    def at(self, stamp: int) -> float | None:
        """Return the interpolated insertion [m] at `stamp` [ns]; None outside the samples."""
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
