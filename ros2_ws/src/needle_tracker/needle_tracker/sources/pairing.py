"""Left and right images of one exposure, brought together by their stamps."""

from __future__ import annotations

import dataclasses
import statistics
from collections import Counter, OrderedDict, deque
from typing import Generic, TypeVar

T = TypeVar("T")

_WAITING_LIMIT = 3
_SKEWS = 100  # the latest pairs, whose stamps' difference is told
_PERIODS, _FEWEST_PERIODS = 15, 3  # the latest, and those without which none is known
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclasses.dataclass(frozen=True)
class Pair(Generic[T]):
    """Two images of one exposure; `stamp` [ns] is the left one's."""

    stamp: int
    left: T
    right: T


class PairMatcher(Generic[T]):
    """Pairs images by stamp; never the latest with the latest.

    An image waits for its partner until a later pair is complete, or too many of its side wait.

    Parameters
    ----------
    tolerance : int or None
        Largest difference of the stamps of a pair [ns]; 0 for cameras on one trigger. None for
        cameras that run freely: half the time from one image of a camera to its next.

    Attributes
    ----------
    pairs : int
        Pairs made.
    unpaired : Counter of str
        Images of each side that were dropped without a partner.
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
        known = len(self._periods) >= _FEWEST_PERIODS
        return round(statistics.median(self._periods) / 2.0) if known else 0

    @property
    def skew(self) -> tuple[float, int] | None:
        """Median and largest difference of the stamps of the latest pairs [ns]; None without."""
        return (statistics.median(self._skews), max(self._skews)) if self._skews else None

    def add(self, side: str, stamp: int, image: T) -> Pair[T] | None:
        """Take an image; return the pair that it completes, None where its partner is missing.

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
        """Return the stamps [ns] of a side's images that wait for their partner."""
        return list(self._waiting[side])

    def _drop_older(self, side: str, stamp: int) -> None:
        waiting = self._waiting[side]
        for old in [other for other in waiting if other < stamp]:
            del waiting[old]
            self.unpaired[side] += 1
