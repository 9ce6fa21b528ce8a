"""Virtual time: an event heap, and a random stream for each random quantity."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable

from needle_core.component import Moment

START_NS = 1_000_000_000
"""Stamp at the start of a run [ns]; in ROS, 0 means an unknown time."""


class Timeline:
    """Event queue, ordered by time and then by order of scheduling.

    Parameters
    ----------
    seed : int
        Seed of all random streams.

    Attributes
    ----------
    now : float
        Virtual time since the start [s].
    clock_offset_ns : int
        Offset of the stamp clock due to injected jumps [ns].
    """

    def __init__(self, seed: int) -> None:
        self.now = 0.0
        self.clock_offset_ns = 0
        self._seed = seed
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._serial = itertools.count()
        self._streams: dict[str, random.Random] = {}
        self._is_interrupted = False

    def stream(self, name: str) -> random.Random:
        """Return the random stream of this name, independent of all others."""
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = random.Random(f"{self._seed}/{name}")
        return stream

    def draw(self, name: str, bounds: tuple[float, float]) -> float:
        """Draw a uniform number between two bounds from a stream."""
        return self.stream(name).uniform(*bounds)

    def call_at(self, when: float, event: Callable[[], None]) -> None:
        """Call `event` at a time [s]."""
        heapq.heappush(self._heap, (when, next(self._serial), event))

    def call_after(self, seconds: float, event: Callable[[], None]) -> None:
        """Call `event` after some time [s]."""
        self.call_at(self.now + seconds, event)

    def moment(self, sent_ns: int = 0) -> Moment:
        """Return the moment of a handler that runs now."""
        return Moment(self.now, self.stamp_ns, sent_ns)

    @property
    def stamp_ns(self) -> int:
        """Current stamp [ns]."""
        return START_NS + self.clock_offset_ns + round(self.now * 1e9)

    def interrupt(self) -> None:
        """Make `run` return after the current event."""
        self._is_interrupted = True

    def run(self, seconds: float, wait_for: Callable[[float], bool] | None = None) -> bool:
        """Run events for some time [s] or until an interrupt; return whether it was interrupted.

        Parameters
        ----------
        seconds : float
            Maximum duration [s].
        wait_for : callable, optional
            Called with the time of the next event [s]; may wait, and returns False if an earlier
            event may have been added in the meantime.
        """
        end = self.now + seconds
        heap, self._is_interrupted = self._heap, False
        while heap and heap[0][0] <= end:
            if wait_for is not None and not wait_for(heap[0][0]):
                continue
            self.now, _, event = heapq.heappop(heap)
            event()
            if self._is_interrupted:
                return True
        self.now = end
        return False
