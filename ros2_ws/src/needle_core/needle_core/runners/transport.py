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
        Its time and chance: every link has a random stream of its own, and its faults another.
    faults : sequence of Fault
        Applied to each message, one after the other.
    """

    def __init__(self, timeline: Timeline, faults: Sequence[Fault]) -> None:
        self._timeline = timeline
        self._faults = faults
        self._streams: dict[Link, tuple[random.Random, random.Random]] = {}
        self._arrived: dict[Link, float] = {}

    def send(
        self,
        link: Link,
        message: Any,
        latency: tuple[float, float],
        arrive: Callable[[Any], None],
    ) -> None:
        """Send a message; `arrive` is called with whatever arrives in its place."""
        streams = self._streams.get(link)
        if streams is None:
            name = f"{link.sender}/{link.topic}/{link.receiver}"
            stream = self._timeline.stream
            streams = self._streams[link] = stream(name), stream(f"faults/{name}")
        timeline = self._timeline
        now = timeline.now
        arrivals = [Arrival(streams[0].uniform(*latency), message)]
        for fault in self._faults:
            for sent in tuple(arrivals):
                spoilt = fault(link, sent.message, now, streams[1])
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
