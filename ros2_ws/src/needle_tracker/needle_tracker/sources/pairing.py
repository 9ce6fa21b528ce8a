"""Left and right images of one exposure, brought together by their stamps."""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from typing import Generic, TypeVar

T = TypeVar("T")

_WAITING_LIMIT = 3
OTHER_SIDE = {"left": "right", "right": "left"}


@dataclasses.dataclass(frozen=True)
class Pair(Generic[T]):
    """Two images of one exposure; `stamp` [ns] is the left one's."""

    stamp: int
    left: T
    right: T


@dataclasses.dataclass
class PairCounts:
    """How the pairing went so far: pairs made, and images dropped without a partner."""

    pairs: int = 0
    unpaired_left: int = 0
    unpaired_right: int = 0

    @property
    def unpaired(self) -> int:
        """Images of either side that never found their partner."""
        return self.unpaired_left + self.unpaired_right


class PairMatcher(Generic[T]):
    """Pairs images by stamp; never the latest with the latest.

    An image waits for its partner until a later pair is complete, or too many of its side wait.

    Parameters
    ----------
    tolerance : int
        Largest difference of the stamps of a pair [ns]; 0 for cameras on one trigger.
    """

    def __init__(self, tolerance: int) -> None:
        self._tolerance = tolerance
        self._waiting: dict[str, OrderedDict[int, T]] = {
            "left": OrderedDict(),
            "right": OrderedDict(),
        }
        self.counts = PairCounts()

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
        others = self._waiting[OTHER_SIDE[side]]
        partner = min(others, key=lambda other: (abs(other - stamp), other), default=None)
        if partner is None or abs(partner - stamp) > self._tolerance:
            waiting = self._waiting[side]
            if waiting.pop(stamp, None) is not None:
                self._count(side)
            waiting[stamp] = image
            if len(waiting) > _WAITING_LIMIT:
                waiting.popitem(last=False)
                self._count(side)
            return None
        other_image = others.pop(partner)
        self._drop_older(OTHER_SIDE[side], partner)
        self._drop_older(side, stamp)
        self.counts.pairs += 1
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
            self._count(side)

    def _count(self, side: str) -> None:
        if side == "left":
            self.counts.unpaired_left += 1
        else:
            self.counts.unpaired_right += 1
