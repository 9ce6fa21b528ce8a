"""Contents of a bag, and its messages, for all tools that read bags."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

from needle_core.files.bag_directory import BagDirectory


def read_contents(path: Path) -> BagDirectory:
    """Return what a bag says about itself: the bag, closed.

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
        return bag


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
