"""Runs a component on the messages of a bag."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from needle_bags.reading.bag_images import plain_image
from needle_bags.reading.bag_messages import SentMessage
from needle_bags.rerun.bag_pass import CONVERTER, Output
from needle_core.component import Component, Moment, Publish
from needle_core.convert import from_ros
from needle_core.messages import Image
from needle_core.runners.bag import BagRunner


class BagStage:
    """A component that processes recorded messages.

    Parameters
    ----------
    component : Component
        The component.
    received : iterable of str
        Its output topics that have a subscriber.

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

    @property
    def topics(self) -> frozenset[str]:
        """Relative names of its input topics."""
        return frozenset(self._rows)

    def process(self, topic: str, sent: SentMessage, message: Any) -> list[Output]:
        """Process a message of a topic, by its relative name; return the outputs."""
        row, at = self._rows[topic], Moment(sent.time * 1e-9, sent.time, sent.time)
        plain = plain_image(message) if row.message is Image else message
        published = self.runner.deliver(row.topic, from_ros(row.message, plain), at)
        return [_output(action, sent.log_time) for action in published]

    def finish(self, log_time: int) -> list[Output]:
        """Return the outputs that remain at the end of the bag."""
        published = self.runner.finish(Moment(math.inf, log_time))
        return [_output(action, log_time) for action in published]


def _output(action: Publish, log_time: int) -> Output:
    stamp = getattr(action.message, "stamp_ns", log_time)
    return Output(action.topic, log_time, stamp, CONVERTER.to_ros(action.message))
