"""Contents of a bag, and its messages, for all tools that read bags."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from needle_bags.format.bag_metadata import BagTopic, offered_profiles
from needle_common.files.bag_directory import BagDirectory


@dataclasses.dataclass(frozen=True)
class BagContents:
    """Contents of a bag, as it tells them itself.

    Attributes
    ----------
    path : Path
        The bag's directory.
    topics : dict of str to BagTopic
        By name.
    counts : dict of str to int
        Messages for each topic.
    start, end : int
        Log times of the first and the last message, system clock [ns]; 0 in an empty bag.
    custom_data : dict of str to str
        What the recorder left in metadata.yaml.
    distribution : str
        ROS distribution it was recorded with; empty where not known.
    """

    path: Path
    topics: dict[str, BagTopic]
    counts: dict[str, int]
    start: int
    end: int
    custom_data: dict[str, str]
    distribution: str


def read_contents(path: Path) -> BagContents:
    """Return what a bag says about itself.

    Parameters
    ----------
    path : Path
        A rosbag2 directory, MCAP or SQLite.

    Raises
    ------
    UserError
        If there is no bag, or it is not whole.
    """
    with BagDirectory(path) as bag:
        custom = bag.information.get("custom_data") or {}
        return BagContents(
            path,
            {
                name: BagTopic(
                    name,
                    topic.type_name,
                    topic.definition,
                    topic.type_hash,
                    offered_profiles(topic.offered_qos),
                )
                for name, topic in bag.topics.items()
            },
            {name: topic.count for name, topic in bag.topics.items()},
            bag.start,
            bag.end,
            {str(key): str(value) for key, value in custom.items()},
            str(bag.information.get("ros_distro") or ""),
        )


def read_messages(path: Path, wanted: Callable[[str], bool]) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, log time [ns], message) in order of log time, of the topics that are wanted.

    Messages are read by the definitions that the bag carries.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    with BagDirectory(path) as bag:
        store = bag.typestore()
        for message in bag.messages(wanted):
            yield message.topic, message.log_time, bag.deserialize(store, message)


def raw_messages(
    path: Path, topics: Collection[str], start: int, stop: int
) -> Iterator[tuple[str, int, bytes]]:
    """Yield (topic, log time [ns], serialised message) with start <= log time < stop, in order.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    with BagDirectory(path) as bag:
        for message in bag.messages(topics.__contains__, start, stop):
            yield message.topic, message.log_time, message.data
