"""Transport between components: latency, order and injected faults."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from needle_core.runners.timeline import Timeline


class Link(NamedTuple):
    """The way of a topic's messages, a service's calls or a port's batches between components."""

    sender: str
    topic: str
    receiver: str


class Arrival(NamedTuple):
    """One arrival of a message.

    Attributes
    ----------
    late : float
        How much later than usual [s].
    message : object
        What arrives.
    overtakes : bool
        Whether it may arrive before what was sent earlier.
    """

    late: float
    message: Any
    overtakes: bool = False


Arrivals = Sequence[Arrival]
Fault = Callable[[Link, Any, float, random.Random], Arrivals | None]
"""(link, message, time [s], random stream) to what arrives, if anything; None: what was sent."""


def drop(topic: str, share: float) -> Fault:
    """Return a fault that loses a share of a topic's messages."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        lost = link.topic == topic and rng.random() < share
        return () if lost else (Arrival(0.0, message),)

    return fault


def delay(topic: str, seconds: float) -> Fault:
    """Return a fault that delays a topic's messages."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return (Arrival(seconds if link.topic == topic else 0.0, message),)

    return fault


def duplicate(topic: str, seconds: float) -> Fault:
    """Return a fault that delivers each message of a topic once more after some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        once = Arrival(0.0, message)
        return (once, Arrival(seconds, message, True)) if link.topic == topic else (once,)

    return fault


def silence(sender: str, begin: float, end: float) -> Fault:
    """Return a fault that loses all that a component sends for some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        lost = link.sender == sender and begin <= now < end
        return () if lost else (Arrival(0.0, message),)

    return fault


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
