"""Transport between components: latency, order and injected faults."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from needle_core.runners.timeline import Timeline


class Link(NamedTuple):
    """Connection between two components: a topic, a service or a port."""

    sender: str
    topic: str
    receiver: str


class Arrival(NamedTuple):
    """Arrival of a message.

    Attributes
    ----------
    late : float
        Additional delay [s].
    message : object
        Message that arrives.
    overtakes : bool
        Whether it may overtake earlier messages.
    """

    late: float
    message: Any
    overtakes: bool = False


Arrivals = Sequence[Arrival]
Fault = Callable[[Link, Any, float, random.Random], Arrivals | None]
"""Maps (link, message, time [s], random stream) to arrivals; None leaves the message unchanged."""


class Transport:
    """Delivers messages with latency, in order unless a fault reorders them.

    Parameters
    ----------
    timeline : Timeline
        Virtual time and random streams, one per link.
    faults : sequence of Fault
        Faults, applied to each message in order.
    """

    def __init__(self, timeline: Timeline, faults: Sequence[Fault]) -> None:
        self._timeline = timeline
        self._faults = faults
        self._arrived: dict[Link, float] = {}

    def send(
        self,
        link: Link,
        message: Any,
        latency: tuple[float, float],
        arrive: Callable[[Any], None],
    ) -> None:
        """Send a message; `arrive` is called for each resulting arrival."""
        timeline, stream = self._timeline, self._timeline.stream("/".join(link))
        now = timeline.now
        arrivals = [Arrival(stream.uniform(*latency), message)]
        for fault in self._faults:
            for sent in tuple(arrivals):
                faulty = fault(link, sent.message, now, stream)
                if faulty is not None:
                    arrivals.remove(sent)
                    arrivals += [
                        Arrival(sent.late + late, changed, sent.overtakes or overtakes)
                        for late, changed, overtakes in faulty
                    ]
        for late, arrived, overtakes in arrivals:
            when = now + late
            if not overtakes:
                when = max(when, self._arrived.get(link, 0.0))
                self._arrived[link] = when
            timeline.call_at(when, partial(arrive, arrived))
