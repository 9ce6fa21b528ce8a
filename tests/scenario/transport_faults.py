"""Faults of the transport between components, for tests."""

from __future__ import annotations

import random
from typing import Any

from needle_core.runners.transport import Arrival, Arrivals, Fault, Link


def drop(topic: str, share: float) -> Fault:
    """Return a fault that drops a share of a topic's messages."""

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
    """Return a fault that delivers each message of a topic again after some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        once = Arrival(0.0, message)
        return (once, Arrival(seconds, message, True)) if link.topic == topic else (once,)

    return fault


def silence(sender: str, begin: float, end: float) -> Fault:
    """Return a fault that drops all messages of a component for some time."""

    def fault(link: Link, message: Any, now: float, rng: random.Random) -> Arrivals:
        lost = link.sender == sender and begin <= now < end
        return () if lost else (Arrival(0.0, message),)

    return fault
