"""Virtual time: an event heap, and a random stream for each thing that is drawn."""

from __future__ import annotations

import heapq
import itertools
import random
from collections.abc import Callable

from needle_core.component import Moment

START_NS = 1_000_000_000
"""Stamp at the begin of a run [ns]; ROS takes 0 for no time yet."""


class Timeline:
    """Events in the order in which they are due, then in that in which they were planned.

    Parameters
    ----------
    seed : int
        Keys every random stream.

    Attributes
    ----------
    now : float
        Virtual time since the begin [s].
    clock_offset_ns : int
        What the clock of the stamps is ahead of where it would be without jumps [ns].
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
        """Return the random stream of one thing: a draw for one shifts nothing of another."""
        stream = self._streams.get(name)
        if stream is None:
            stream = self._streams[name] = random.Random(f"{self._seed}/{name}")
        return stream

    def draw(self, name: str, bounds: tuple[float, float]) -> float:
        """Return a number between two bounds out of a stream."""
        return self.stream(name).uniform(*bounds)

    def call_at(self, when: float, event: Callable[[], None]) -> None:
        """Call `event` at a time [s]."""
        heapq.heappush(self._heap, (when, next(self._serial), event))

    def call_after(self, seconds: float, event: Callable[[], None]) -> None:
        """Call `event` after some time [s]."""
        self.call_at(self.now + seconds, event)

    def moment(self, sent_ns: int = 0) -> Moment:
        """Return the times of a handler that runs now."""
        return Moment(self.now, self.stamp_ns, sent_ns)

    @property
    def stamp_ns(self) -> int:
        """Stamp of now [ns]."""
        return START_NS + self.clock_offset_ns + round(self.now * 1e9)

    def interrupt(self) -> None:
        """Let `run` return after the present event."""
        self._is_interrupted = True

    def run(self, seconds: float, reach: Callable[[float], bool] | None = None) -> bool:
        """Run what is due, for some time [s] or until an interrupt; return whether there was one.

        Parameters
        ----------
        seconds : float
            How long at most [s].
        reach : callable, optional
            Takes the time of the next event [s], may wait for it, and returns False where another
            may have come before it.
        """
        end = self.now + seconds
        heap, self._is_interrupted = self._heap, False
        while heap and heap[0][0] <= end:
            if reach is not None and not reach(heap[0][0]):
                continue
            self.now, _, event = heapq.heappop(heap)
            event()
            if self._is_interrupted:
                return True
        self.now = end
        return False
