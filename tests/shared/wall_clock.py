"""Simulated wall clock: it advances while a component waits or computes."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable


class WallClock:
    """Clock and bell of a `PacedRunner`, and scheduled external events."""

    def __init__(self) -> None:
        self.now = 100.0
        self._rung = False
        self._planned: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()

    def __call__(self) -> float:
        return self.now

    def at(self, when: float, happen: Callable[[], None]) -> None:
        """Schedule an event at a time [s]."""
        heapq.heappush(self._planned, (when, next(self._number), happen))

    def every(self, period: float, happen: Callable[[], None]) -> None:
        """Schedule a periodic event."""

        def again() -> None:
            happen()
            self.at(self.now + period, again)

        self.at(self.now + period, again)

    def spend(self, seconds: float, *, until_rung: bool = False) -> None:
        """Advance time."""
        end = self.now + seconds
        while self._planned and self._planned[0][0] <= end:
            if until_rung and self._rung:
                return
            self.now, _, happen = heapq.heappop(self._planned)
            happen()
        if not (until_rung and self._rung):
            self.now = end

    # ---- the bell -------------------------------------------------------------------------------

    def set(self) -> None:
        self._rung = True

    def clear(self) -> None:
        self._rung = False

    def is_set(self) -> bool:
        return self._rung

    def wait(self, timeout: float) -> bool:
        self.spend(timeout, until_rung=True)
        return self._rung
