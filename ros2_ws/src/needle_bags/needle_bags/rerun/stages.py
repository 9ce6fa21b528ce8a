"""Stages of the rig that process the messages of a bag, and their outputs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any

from rosbags.typesys import Stores, get_typestore

from needle_bags.reading.bag_images import plain_image
from needle_bags.reading.bag_messages import SentMessage
from needle_core.component import Component, Moment, Publish
from needle_core.convert import from_ros, to_ros
from needle_core.message_types import rosbags_types
from needle_core.messages import Image
from needle_core.runners.bag import BagRunner

_STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = rosbags_types(_STORE)
"""rosbags' message classes."""


@dataclasses.dataclass(frozen=True)
class Output:
    """Message from the current code.

    Attributes
    ----------
    topic : str
        Relative name.
    log_time : int
        Log time of the input that caused it [ns].
    stamp : int
        Stamp of the message [ns].
    message : Any
        The message, as an object of rosbags.
    """

    topic: str
    log_time: int
    stamp: int
    message: Any

    @property
    def type_name(self) -> str:
        """Name of the message's type."""
        return str(self.message.__msgtype__)

    @property
    def data(self) -> bytes:
        """The message as CDR."""
        return bytes(_STORE.serialize_cdr(self.message, self.type_name))


class Stage:
    """Part of the rig that turns messages into outputs.

    Attributes
    ----------
    topics : frozenset of str
        Names of its input topics, relative to the rig's namespace, or absolute.
    """

    topics: frozenset[str]

    def process(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Process a message of a topic, given by relative name; return the outputs."""
        raise NotImplementedError

    def finish(self, log_time: int) -> list[Output]:
        """Return the outputs that remain at the end of the bag."""
        return []


class BagStage(Stage):
    """Stage that runs a component on recorded messages.

    Parameters
    ----------
    component : Component
        The component.
    received : iterable of str
        Output topics of the component that have a subscriber.

    Attributes
    ----------
    runner : BagRunner
        Runner of the component.
    """

    def __init__(self, component: Component, received: Iterable[str]) -> None:
        self.runner = BagRunner(component, received)
        self._rows = {row.topic: row for row in component.inputs}
        images = [row for row in component.inputs if row.message is Image]
        self._rows |= {f"{row.topic}/compressed": row for row in images}
        self.topics = frozenset(self._rows)

    def process(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Process a message of a topic, given by relative name; return the outputs."""
        row, at = self._rows[topic], Moment(sent.time * 1e-9, sent.time, sent.time)
        is_image = row.message is Image
        content = plain_image(message) if is_image else from_ros(row.message, message)
        published = self.runner.deliver(row.topic, content, at)
        return [_output(action, sent.log_time) for action in published]

    def finish(self, log_time: int) -> list[Output]:
        """Return the outputs that remain at the end of the bag."""
        published = self.runner.finish(Moment(math.inf, log_time))
        return [_output(action, log_time) for action in published]


def _output(action: Publish, log_time: int) -> Output:
    stamp = getattr(action.message, "stamp_ns", log_time)
    return Output(action.topic, log_time, stamp, to_ros(action.message, TYPES))
