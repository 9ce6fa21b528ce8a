"""Writes a bag anew, message by message, from another one."""

from __future__ import annotations

import functools
import struct
from collections.abc import Mapping
from pathlib import Path

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from needle_bags.format.bag_metadata import USUAL_QOS
from needle_bags.format.bag_writer import BagWriter
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic

_STAMP_END = 12


def standard_topic(name: str, type_name: str) -> BagTopic:
    """Return a topic of a standard type, for messages that the bag did not have."""
    store = _jazzy()
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return BagTopic(name, type_name, definition, store.hash_rihs01(type_name), (USUAL_QOS,))


def standard_text(text: str) -> bytes:
    """Return a std_msgs/String as CDR."""
    name = "std_msgs/msg/String"
    store = _jazzy()
    return bytes(store.serialize_cdr(store.types[name](data=text), name))


@functools.cache
def _jazzy() -> Typestore:
    """Return Jazzy's types, a tenth of a second of work: those who only read do without."""
    return get_typestore(Stores.ROS2_JAZZY)


def stamp_of(data: bytes) -> int:
    """Return the stamp [ns] of a message (CDR) that begins with a header.

    Raises
    ------
    UserError
        If it is too short for one.
    """
    if len(data) < _STAMP_END:
        raise UserError(f"a message of {len(data)} bytes has no header with a stamp")
    order = "<" if data[1] & 1 else ">"
    sec, nanosec = struct.unpack_from(f"{order}iI", data, 4)
    return int(sec) * 10**9 + int(nanosec)


class BagCopy:
    """A bag being written, compressed, topics announced as their first message comes.

    Parameters
    ----------
    directory : Path
        The new bag.
    distribution : str
        ROS distribution of its message types.
    custom_data : mapping
        Texts for its metadata.

    Raises
    ------
    UserError
        If the directory holds a bag already or cannot be made.
    """

    def __init__(self, directory: Path, distribution: str, custom_data: Mapping[str, str]) -> None:
        self._writer = BagWriter(directory, distribution=distribution, compression="zstd")
        self._topics: dict[str, int] = {}
        for key, text in custom_data.items():
            self._writer.set_custom_data(key, text)

    def put(self, topic: BagTopic, data: bytes, log_time: int, sent: int) -> None:
        """Append a message that was received at `log_time` and sent at `sent` [ns].

        Raises
        ------
        UserError
            If the disk refuses the data.
        """
        if topic.name not in self._topics:
            self._topics[topic.name] = self._writer.add_topic(topic)
        self._writer.write(self._topics[topic.name], data, log_time, sent)

    def close(self) -> None:
        """Complete the bag; raises UserError if the disk refuses the data."""
        self._writer.close()
