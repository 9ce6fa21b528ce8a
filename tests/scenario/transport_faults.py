"""Faults of the transport between components, for tests."""

from __future__ import annotations

from needle_core.runners.transport import Arrival, Fault


def drop(topic: str, share: float) -> Fault:
    """Return a fault that drops a share of a topic's messages."""
    return lambda link, message, now, rng: (
        () if link.topic == topic and rng.random() < share else None
    )


def delay(topic: str, seconds: float) -> Fault:
    """Return a fault that delays a topic's messages."""
    return lambda link, message, now, rng: (
        (Arrival(seconds, message),) if link.topic == topic else None
    )


def duplicate(topic: str, seconds: float) -> Fault:
    """Return a fault that delivers each message of a topic again after some time."""
    return lambda link, message, now, rng: (
        (Arrival(0.0, message), Arrival(seconds, message, True)) if link.topic == topic else None
    )
