"""Hears a topic without being held up by it: what is too long is not looked into."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

# Turning a message into Python takes up to 200 ns a byte: 1 ms.
LONGEST = 4096


def listen(
    node: Node,
    kind: type,
    topic: str,
    callback: Callable[[list[Any]], None],
    qos: QoSProfile,
    *,
    refuse: Callable[[str, str, str], None],
    at_once: int = 1,
) -> Subscription[Any]:
    """Subscribe to messages that are short by their nature.

    They come as bytes, and become messages only where they are no longer than `LONGEST`. Each is
    decoded on its own: one that is too long or cannot be decoded is refused by its topic, and those
    before and after it are taken.

    Parameters
    ----------
    node : Node
        Who listens.
    kind : type
        Of the messages.
    topic : str
        Its name.
    callback : callable
        Takes those that have come since the last call, oldest first.
    qos : QoSProfile
        Of the subscription; what comes beyond its depth between two calls is lost.
    refuse : callable
        Takes the topic, the kind of trouble, and what is wrong.
    at_once : int
        How many messages are taken off the queue for a call, refused ones among them.
    """

    def on_bytes(first: bytes) -> None:
        taken = itertools.chain((first,), iter(lambda: _next(subscription, kind), None))
        messages = []
        for data in itertools.islice(taken, at_once):
            if len(data) > LONGEST:
                refuse(topic, "too long", f"{len(data)} bytes, at most {LONGEST}")
                continue
            try:
                messages.append(deserialize_message(data, kind))
            except Exception as error:  # noqa: BLE001 - whatever the middleware raises
                refuse(topic, "undecodable", f"{len(data)} bytes: {type(error).__name__}: {error}")
        if messages:
            callback(messages)

    subscription: Subscription[Any] = node.create_subscription(kind, topic, on_bytes, qos, raw=True)
    return subscription


def _next(subscription: Subscription[Any], kind: type) -> bytes | None:
    with subscription.handle:
        taken = subscription.handle.take_message(kind, True)
    return None if taken is None else bytes(taken[0])
