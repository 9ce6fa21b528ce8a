"""Faults of deliveries: what a runner lets arrive in place of a message."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple


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
