"""A bag's messages in the order in which they were sent.

The order of arrival at the recorder is not the order of arrival at the nodes: on a busy machine a
topic can be late by tens of milliseconds, and an answer then stands before its question. The order
of sending is one in which every message has its causes before it. It is known from MCAP bags whose
senders' clocks agree with the recorder's; else what was received first comes first.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

from needle_core.files.bag_directory import BagDirectory, SentMessage

__all__ = ["Reorder", "SentMessage", "messages_as_sent", "raw_as_sent"]

# A topic whose fastest message took less or more than this [ns] was sent by another clock.
_LEAST_DELAY, _MOST_DELAY = -1_000_000, 200_000_000
# Fewer messages than this say nothing about a clock: each may have waited for the recorder.
_ENOUGH = 20


Reorder = Callable[[list[SentMessage]], list[tuple[int, SentMessage]]]
"""Gives messages, as sent, the times [ns] by which they come, in that order."""


def messages_as_sent(
    path: Path,
    wanted: Callable[[str], bool],
    is_large: Callable[[str], bool],
    reorder: Reorder | None = None,
) -> Iterator[tuple[SentMessage, Any]]:
    """Yield messages as they are and deserialized, in the order of `raw_as_sent`.

    `reorder` gives the messages that are not large another order, where senders' clocks agree.
    """
    with BagDirectory(path) as bag:
        store = bag.typestore()
        for sent in _as_sent(bag, wanted, is_large, reorder):
            yield sent, bag.deserialize(store, sent)


def raw_as_sent(
    path: Path, wanted: Callable[[str], bool], is_large: Callable[[str], bool]
) -> Iterator[SentMessage]:
    """Yield the messages of the wanted topics in the order of sending.

    Parameters
    ----------
    path : Path
        The bag.
    wanted : callable
        Whether a topic is.
    is_large : callable
        Whether a topic's messages are not to be kept in memory, such as images; such topics are
        expected in order.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    with BagDirectory(path) as bag:
        yield from _as_sent(bag, wanted, is_large, None)


def _as_sent(
    bag: BagDirectory,
    wanted: Callable[[str], bool],
    is_large: Callable[[str], bool],
    reorder: Reorder | None,
) -> Iterator[SentMessage]:
    small = list(bag.messages(lambda name: wanted(name) and not is_large(name)))
    streamed = bag.messages(lambda name: wanted(name) and is_large(name))
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
    fastest = [min(values) for values in delays.values() if len(values) >= _ENOUGH]
    return all(_LEAST_DELAY <= delay <= _MOST_DELAY for delay in fastest)
