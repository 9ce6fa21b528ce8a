"""One row per topic that a node hears: its type, its QoS, and what a message of it does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Generic, TypeVar

from rclpy.qos import QoSProfile

Effect = TypeVar("Effect")


@dataclasses.dataclass(frozen=True)
class TopicInput(Generic[Effect]):
    """A topic that a node hears, and `rerun` takes from a bag.

    Attributes
    ----------
    topic : str
        Its relative name.
    kind : type
        Its message class.
    qos : QoSProfile
        How the node subscribes to it.
    take : callable
        (message, when [the node's unit]) to what follows.
    """

    topic: str
    kind: type[Any]
    qos: QoSProfile
    take: Callable[[Any, Any], Iterable[Effect]]
