"""Metadata of a bag in rosbag2's metadata.yaml (version 9)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v9

from needle_core.files.bag_path import METADATA_FILE
from needle_core.files.bag_topic import BagTopic
from needle_core.files.file_access import replace_file

METADATA_VERSION: Final = 9
_NO_LIMIT: Final = QosTime(*divmod(2**63 - 1, 10**9))
# Default for publishers whose QoS is unknown.
USUAL_QOS: Final = Qos(
    QosHistory.UNKNOWN,
    0,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    _NO_LIMIT,
    _NO_LIMIT,
    QosLiveliness.AUTOMATIC,
    _NO_LIMIT,
    False,
)


@dataclasses.dataclass
class DataFile:
    """Contents of a data file.

    Attributes
    ----------
    name : str
        File name.
    counts : dict of str to int
        Number of messages by topic.
    first, last : int or None, int
        Log times of the earliest and latest message, system clock [ns].
    """

    name: str
    counts: dict[str, int] = dataclasses.field(default_factory=dict)
    first: int | None = None
    last: int = 0

    @property
    def message_count(self) -> int:
        """Number of messages in the file."""
        return sum(self.counts.values())

    def add(self, topic: str, log_time: int) -> None:
        """Count a message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if self.first is None or log_time < self.first:
            self.first = log_time
        self.last = max(self.last, log_time)


def bag_information(
    files: Sequence[DataFile],
    topics: Sequence[BagTopic],
    custom_data: Mapping[str, str],
    distribution: str,
    *,
    is_compressed: bool = False,
) -> dict[str, Any]:
    """Return the content of metadata.yaml below `rosbag2_bagfile_information`.

    Set `is_compressed` if messages are compressed individually.
    """
    starts = [file.first for file in files if file.first is not None]
    start = min(starts, default=0)
    last = max((file.last for file in files), default=0)
    return {
        "version": METADATA_VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": max(0, last - start)},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.message_count for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": _topic_metadata(topic),
                "message_count": sum(file.counts.get(topic.name, 0) for file in files),
            }
            for topic in topics
        ],
        "compression_format": "zstd" if is_compressed else "",
        "compression_mode": "message" if is_compressed else "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.first or 0},
                "duration": {"nanoseconds": max(0, file.last - (file.first or 0))},
                "message_count": file.message_count,
            }
            for file in files
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": distribution,
    }


def write_metadata(directory: Path, information: Mapping[str, Any]) -> None:
    """Write metadata.yaml atomically, and flush it to the disk.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    text = to_yaml({"rosbag2_bagfile_information": dict(information)})
    replace_file(directory / METADATA_FILE, text.encode())


def channel_metadata(topic: BagTopic) -> dict[str, str]:
    """Return the metadata of a topic's MCAP channel."""
    profiles = dump_qos_v9(list(topic.offered_qos))
    return {
        "offered_qos_profiles": to_yaml(profiles).strip() if profiles else "",
        "topic_type_hash": topic.type_hash,
    }


def to_yaml(value: Mapping[str, Any] | Sequence[Any]) -> str:
    """Return YAML without anchors, for simple readers."""
    text: str = yaml.dump(value, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True)
    return text


def _topic_metadata(topic: BagTopic) -> dict[str, Any]:
    return {
        "name": topic.name,
        "type": topic.type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": dump_qos_v9(list(topic.offered_qos)),
        "type_description_hash": topic.type_hash,
    }


class _PlainDumper(yaml.SafeDumper):
    """YAML dumper without anchors, which rosbag2's reader does not support."""

    def ignore_aliases(self, data: Any) -> bool:
        return True
