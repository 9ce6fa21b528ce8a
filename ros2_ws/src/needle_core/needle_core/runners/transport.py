"""The ways between components: latency, order, faults."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from needle_core.runners.faults import Arrival, Fault, Link
from needle_core.runners.timeline import Timeline


class Transport:
    """Lets what is sent arrive, in order but for what a fault lets overtake.

    Parameters
    ----------
    timeline : Timeline
        Its time and chance: every link has a random stream of its own.
    faults : sequence of Fault
        Applied to each message, one after the other.
    """

    def __init__(self, timeline: Timeline, faults: Sequence[Fault]) -> None:
        self._timeline = timeline
        self._faults = faults
        self._streams: dict[Link, random.Random] = {}
        self._arrived: dict[Link, float] = {}

    def send(
        self,
        link: Link,
        message: Any,
        latency: tuple[float, float],
        arrive: Callable[[Any], None],
    ) -> None:
        """Send a message; `arrive` is called with whatever arrives in its place."""
        stream = self._streams.get(link)
        if stream is None:
            stream = self._streams[link] = self._timeline.stream("/".join(link))
        timeline = self._timeline
        now = timeline.now
        arrivals = [Arrival(stream.uniform(*latency), message)]
        for fault in self._faults:
            for sent in tuple(arrivals):
                spoilt = fault(link, sent.message, now, stream)
                if spoilt is not None:
                    arrivals.remove(sent)
                    arrivals += [
                        Arrival(sent.late + late, changed, sent.overtakes or overtakes)
                        for late, changed, overtakes in spoilt
                    ]
        for late, arrived, overtakes in arrivals:
            when = now + late
            if not overtakes:
                when = max(when, self._arrived.get(link, 0.0))
                self._arrived[link] = when
            timeline.call_at(when, partial(arrive, arrived))
