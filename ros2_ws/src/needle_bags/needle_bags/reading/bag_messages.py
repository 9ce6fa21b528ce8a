"""Messages of a bag in the order of reception or of sending.

The order of arrival at the recorder is not the order of arrival at the nodes: on a busy machine a
topic can be late by tens of milliseconds, and a reply may be recorded before its request. In the
order of sending, every message follows its causes. That order is available for MCAP bags if the
senders' clocks agree with the recorder's; otherwise the order of reception is used.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from needle_core.files.bag_directory import BagDirectory, SentMessage

__all__ = [
    "IMAGE_TYPES",
    "Reorder",
    "SentMessage",
    "messages_as_sent",
    "raw_as_sent",
    "read_contents",
    "read_messages",
]

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
# If the fastest message of a topic has a delay outside these bounds [ns], the clocks differ.
_MIN_DELAY, _MAX_DELAY = -1_000_000, 200_000_000
# With fewer messages, even the smallest delay may be due to the recorder.
_MIN_MESSAGES = 20


Reorder = Callable[[list[SentMessage]], list[tuple[int, SentMessage]]]
"""Assigns reception times [ns] to messages in the order of sending; returns them in that order."""


def read_contents(path: Path) -> BagDirectory:
    """Return a closed bag with its topics, counts and metadata.

    Parameters
    ----------
    path : Path
        A rosbag2 directory, MCAP or SQLite.

    Raises
    ------
    UserError
        If there is no bag, or it is incomplete.
    """
    with BagDirectory(path) as bag:
        return bag


def read_messages(path: Path, select: Callable[[str], bool]) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, log time [ns], message) of the selected topics, in order of log time.

    Messages are decoded with the definitions in the bag.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    with BagDirectory(path) as bag:
        store = bag.typestore()
        for message in bag.messages(select):
            yield message.topic, message.log_time, bag.deserialize(store, message)


def messages_as_sent(
    path: Path, select: Callable[[str], bool], reorder: Reorder | None = None
) -> Iterator[tuple[SentMessage, Any]]:
    """Yield raw and decoded messages in the order of `raw_as_sent`.

    `reorder` changes the order of all messages but images, if the senders' clocks agree.
    """
    with BagDirectory(path) as bag:
        store = bag.typestore()
        for sent in _as_sent(bag, select, reorder):
            yield sent, bag.deserialize(store, sent)


def raw_as_sent(path: Path, select: Callable[[str], bool]) -> Iterator[SentMessage]:
    """Yield the messages of the selected topics in the order of sending.

    Images do not fit into memory, so each image topic is assumed to be in that order already.

    Parameters
    ----------
    path : Path
        The bag.
    select : callable
        Returns whether a topic is selected.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    with BagDirectory(path) as bag:
        yield from _as_sent(bag, select, None)


def _as_sent(
    bag: BagDirectory, select: Callable[[str], bool], reorder: Reorder | None
) -> Iterator[SentMessage]:
    images = {name for name, topic in bag.topics.items() if topic.type_name in IMAGE_TYPES}
    small = list(bag.messages(lambda name: select(name) and name not in images))
    streamed = bag.messages(lambda name: select(name) and name in images)
    if not _clocks_agree(small):
        small, streamed = list(map(_as_received, small)), map(_as_received, streamed)
        reorder = None
    timed = (reorder or _in_order)(small)
    both = heapq.merge(timed, ((sent.time, sent) for sent in streamed), key=itemgetter(0))
    yield from map(itemgetter(1), both)


def _in_order(messages: list[SentMessage]) -> list[tuple[int, SentMessage]]:
    ordered = sorted(messages, key=lambda sent: (sent.time, sent.log_time))
    return [(sent.time, sent) for sent in ordered]


def _as_received(message: SentMessage) -> SentMessage:
    return message._replace(time=message.log_time)


def _clocks_agree(messages: Iterable[SentMessage]) -> bool:
    delays: dict[str, list[int]] = defaultdict(list)
    for message in messages:
        delays[message.topic].append(message.log_time - message.time)
    fastest = [min(values) for values in delays.values() if len(values) >= _MIN_MESSAGES]
    return all(_MIN_DELAY <= delay <= _MAX_DELAY for delay in fastest)
