"""Faults of deliveries: what a runner lets arrive in place of a message."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Link:
    """The way of a topic's messages from one component to another."""

    sender: str
    topic: str
    receiver: str


Arrivals = Sequence[tuple[float, Any]]
Fault = Callable[[Link, Any, float, random.Random], Arrivals]
"""(link, message, time [s], random stream) to pairs of extra delay [s] and message; none: lost."""


def drop(topic: str, share: float) -> Fault:
    """Return a fault that loses a share of a topic's messages."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return () if link.topic == topic and rng.random() < share else ((0.0, message),)

    return fault


def delay(topic: str, seconds: float) -> Fault:
    """Return a fault that delays a topic's messages."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return ((seconds if link.topic == topic else 0.0, message),)

    return fault


def duplicate(topic: str, seconds: float) -> Fault:
    """Return a fault that delivers each message of a topic once more after some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        once = ((0.0, message),)
        return (*once, (seconds, message)) if link.topic == topic else once

    return fault


def silence(sender: str, begin: float, end: float) -> Fault:
    """Return a fault that loses all that a component sends for some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        return () if link.sender == sender and begin <= now < end else ((0.0, message),)

    return fault
