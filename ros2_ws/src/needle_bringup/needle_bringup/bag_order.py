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
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from needle_bringup.bag_files import (
    BagContents,
    raw_messages,
    read_contents,
    readable,
    require_bag,
)
from needle_bringup.bag_metadata import METADATA_FILE

# A topic whose fastest message took less or more than this [ns] was sent by another clock.
_LEAST_DELAY, _MOST_DELAY = -1_000_000, 200_000_000
# Fewer messages than this say nothing about a clock: each may have waited for the recorder.
_ENOUGH = 20


class SentMessage(NamedTuple):
    """A message as it is in the bag.

    Attributes
    ----------
    time, log_time : int
        When it was sent (received, where the bag does not tell) and received [ns].
    topic, type_name : str
        Its topic and type.
    data : bytes
        The message as CDR.
    """

    time: int
    log_time: int
    topic: str
    type_name: str
    data: bytes


Reorder = Callable[[list[SentMessage]], list[SentMessage]]


def messages_as_sent(
    path: Path, wanted: Callable[[str], bool], is_large: Callable[[str], bool], reorder: Reorder
) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, log time [ns], message) in the order of sending; as `raw_as_sent` otherwise."""
    require_bag(path)
    store = get_typestore(Stores.ROS2_JAZZY)
    with readable(path), AnyReader([path], default_typestore=store) as reader:
        for sent in raw_as_sent(path, wanted, is_large, reorder):
            yield sent.topic, sent.log_time, reader.deserialize(sent.data, sent.type_name)


def raw_as_sent(
    path: Path,
    wanted: Callable[[str], bool],
    is_large: Callable[[str], bool],
    reorder: Reorder | None = None,
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
    reorder : callable, optional
        Gives the messages that are not large other times.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    contents = read_contents(path)
    topics = {name for name in contents.topics if wanted(name)}
    large = {name for name in topics if is_large(name)}
    with readable(path):
        files = _plain_mcap_files(path)
        small = list(_read(files, topics - large))
        streamed: Iterable[SentMessage] = _read(files, large)
        if not files or not _clocks_agree(small):
            small = list(_as_received(contents, topics - large))
            streamed = _as_received(contents, large)
        if reorder is not None:
            small = reorder(small)
        small.sort(key=lambda sent: (sent.time, sent.log_time))
        yield from heapq.merge(small, streamed, key=lambda sent: sent.time)


def _as_received(contents: BagContents, topics: set[str]) -> Iterator[SentMessage]:
    end = contents.end + 1
    for topic, log_time, data in raw_messages(contents.path, topics, contents.start, end):
        yield SentMessage(log_time, log_time, topic, contents.topics[topic].type_name, data)


def _plain_mcap_files(path: Path) -> list[Path]:
    """Return the data files that the mcap reader can open; none where rosbags alone can."""
    text = (path / METADATA_FILE).read_text(encoding="utf-8")
    information = yaml.safe_load(text)["rosbag2_bagfile_information"]
    if information["storage_identifier"] != "mcap" or information.get("compression_mode"):
        return []
    return [path / name for name in information["relative_file_paths"]]


def _read(files: Iterable[Path], topics: set[str]) -> Iterator[SentMessage]:
    if not topics:
        return
    for file in files:
        with file.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages(topics=list(topics)):
                yield SentMessage(
                    message.publish_time,
                    message.log_time,
                    channel.topic,
                    schema.name if schema is not None else "",
                    message.data,
                )


def _clocks_agree(messages: Iterable[SentMessage]) -> bool:
    delays: dict[str, list[int]] = defaultdict(list)
    for message in messages:
        delays[message.topic].append(message.log_time - message.time)
    fastest = [min(values) for values in delays.values() if len(values) >= _ENOUGH]
    return all(_LEAST_DELAY <= delay <= _MOST_DELAY for delay in fastest)
