"""Writes a rosbag2 directory: MCAP data with its index, and metadata.yaml (version 9)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import yaml
from mcap.writer import CompressionType, Writer

from needle_common.errors import UserError

METADATA_VERSION = 9
LIBRARY = "needle_bringup"
METADATA_FILE = "metadata.yaml"
_NANOSECONDS = 1_000_000_000
INFINITE_NS = 2**63 - 1


class BagWriteError(Exception):
    """The disk refused the bag's data; the message says why and where."""


@dataclasses.dataclass(frozen=True)
class OfferedQos:
    """Quality of service that one publisher offers, in rosbag2's words.

    Attributes
    ----------
    history, reliability, durability, liveliness : str
        Names of rmw's policies in lower case, e.g. `keep_last`, `transient_local`.
    depth : int
        Queue length; 0 where DDS does not tell it.
    deadline, lifespan, lease_duration : int
        Durations in ns; `INFINITE_NS` for none.
    """

    history: str = "unknown"
    depth: int = 0
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: int = INFINITE_NS
    lifespan: int = INFINITE_NS
    liveliness: str = "automatic"
    lease_duration: int = INFINITE_NS

    def as_rosbag2(self) -> dict[str, Any]:
        """Return the profile as metadata.yaml has it from version 9 on."""

        def duration(nanoseconds: int) -> dict[str, int]:
            return {"sec": nanoseconds // _NANOSECONDS, "nsec": nanoseconds % _NANOSECONDS}

        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": duration(self.deadline),
            "lifespan": duration(self.lifespan),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": duration(self.lease_duration),
            "avoid_ros_namespace_conventions": False,
        }


@dataclasses.dataclass(frozen=True)
class BagTopic:
    """What a bag says about a topic, beside its messages.

    Attributes
    ----------
    name : str
        Absolute name.
    type_name : str
        `package/msg/Name`.
    definition : str
        Full definition text (`message_definitions.full_definition`).
    type_hash : str
        `RIHS01_...` as the publishers announce it, or an empty text.
    offered_qos : tuple of OfferedQos
        One for each publisher.
    """

    name: str
    type_name: str
    definition: str
    type_hash: str = ""
    offered_qos: tuple[OfferedQos, ...] = ()


class BagWriter:
    """One bag being written; not thread-safe: one thread owns it.

    Parameters
    ----------
    directory : Path
        The bag; made if it does not exist.
    distribution : str
        ROS distribution whose message types the bag holds.
    chunk_size : int
        Bytes after which a chunk is written out.

    Raises
    ------
    UserError
        If the directory holds a bag already or cannot be made.
    """

    def __init__(
        self, directory: Path, *, distribution: str = "jazzy", chunk_size: int = 2**20
    ) -> None:
        refuse_existing_bag(directory)
        self.directory = directory
        self._data_file = f"{directory.absolute().name}_0.mcap"
        self._distribution = distribution
        self._topics: dict[int, BagTopic] = {}
        self._counts: dict[int, int] = {}
        self._schemas: dict[tuple[str, str], int] = {}
        self._custom_data: dict[str, str] = {}
        self._first: int | None = None
        self._last = 0
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._stream: IO[bytes] = (directory / self._data_file).open("xb")
        except OSError as error:
            raise UserError(f"cannot record into {directory}: {error.strerror}") from error
        self._mcap = Writer(self._stream, chunk_size=chunk_size, compression=CompressionType.NONE)
        self._mcap.start(profile="ros2", library=LIBRARY)
        self._mcap.add_metadata("rosbag2", {"ROS_DISTRO": distribution})

    @property
    def message_count(self) -> int:
        """Messages written so far."""
        return sum(self._counts.values())

    def add_topic(self, topic: BagTopic) -> int:
        """Announce a topic and return the channel number that its messages are written with."""
        key = (topic.type_name, topic.definition)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(
                topic.type_name, "ros2msg", topic.definition.encode()
            )
        profiles = [qos.as_rosbag2() for qos in topic.offered_qos]
        channel = self._mcap.register_channel(
            topic.name,
            "cdr",
            self._schemas[key],
            {
                "offered_qos_profiles": _to_yaml(profiles).strip() if profiles else "",
                "topic_type_hash": topic.type_hash,
            },
        )
        self._topics[channel] = topic
        self._counts[channel] = 0
        return channel

    def write(self, channel: int, data: bytes, log_time: int, publish_time: int) -> None:
        """Append one serialised message.

        Parameters
        ----------
        channel : int
            Number from `add_topic`.
        data : bytes
            The message as CDR with its header.
        log_time, publish_time : int
            When it was received and sent, system clock [ns].

        Raises
        ------
        BagWriteError
            If the disk refuses the data.
        """
        try:
            self._mcap.add_message(
                channel, log_time, data, publish_time, self._counts[channel] & 0xFFFFFFFF
            )
        except OSError as error:
            raise self._failure(error) from error
        self._counts[channel] += 1
        self._first = log_time if self._first is None else min(self._first, log_time)
        self._last = max(self._last, log_time)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a named MCAP metadata record."""
        try:
            self._mcap.add_metadata(name, dict(values))
        except OSError as error:
            raise self._failure(error) from error

    def add_attachment(self, name: str, media_type: str, data: bytes, time: int) -> None:
        """Append a file as an MCAP attachment; `time` is the system clock's [ns]."""
        try:
            self._mcap.add_attachment(time, time, name, media_type, data)
        except OSError as error:
            raise self._failure(error) from error

    def set_custom_data(self, key: str, value: str) -> None:
        """Set one text of the `custom_data` in metadata.yaml, which every bag reader shows."""
        self._custom_data[key] = value

    def flush(self) -> None:
        """Close the chunk in progress, so that a crash loses nothing written before."""
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Write the index and metadata.yaml; the bag is whole after this.

        Raises
        ------
        BagWriteError
            If the disk refuses the data.
        """
        information = self._information()
        try:
            self._mcap.add_metadata("rosbag2", {"serialized_metadata": _to_yaml(information)})
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
            # Renamed into place: a metadata.yaml that exists is complete.
            partial = self.directory / f"{METADATA_FILE}.tmp"
            partial.write_text(
                _to_yaml({"rosbag2_bagfile_information": information}), encoding="utf-8"
            )
            partial.replace(self.directory / METADATA_FILE)
        except OSError as error:
            raise self._failure(error) from error

    def abandon(self) -> None:
        """Close the file as it is, without an index: after a `BagWriteError`."""
        try:
            self._stream.close()
        except OSError:
            # The buffer's rest meets the same full disk again.
            return

    def _failure(self, error: OSError) -> BagWriteError:
        return BagWriteError(f"cannot write {self.directory / self._data_file}: {error.strerror}")

    def _information(self) -> dict[str, Any]:
        start = {"nanoseconds_since_epoch": self._first or 0}
        duration = {"nanoseconds": self._last - (self._first or 0)}
        return {
            "version": METADATA_VERSION,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": self.message_count,
            "topics_with_message_count": [
                {"topic_metadata": _topic_metadata(topic), "message_count": self._counts[channel]}
                for channel, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._data_file],
            "files": [
                {
                    "path": self._data_file,
                    "starting_time": start,
                    "duration": duration,
                    "message_count": self.message_count,
                }
            ],
            "custom_data": self._custom_data or None,
            "ros_distro": self._distribution,
        }


def refuse_existing_bag(directory: Path) -> None:
    """Raise a `UserError` if a directory holds (a part of) a bag already, or is a file."""
    if directory.exists() and not directory.is_dir():
        raise UserError(f"cannot record into {directory}: it is a file")
    if (directory / METADATA_FILE).exists() or any(directory.glob("*.mcap")):
        raise UserError(f"{directory} holds a bag already: name a new directory")


def _topic_metadata(topic: BagTopic) -> dict[str, Any]:
    return {
        "name": topic.name,
        "type": topic.type_name,
        "serialization_format": "cdr",
        "offered_qos_profiles": [qos.as_rosbag2() for qos in topic.offered_qos],
        "type_description_hash": topic.type_hash,
    }


class _PlainDumper(yaml.SafeDumper):
    """Writes no anchors: rosbag2's reader and other simple ones do not follow them."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _to_yaml(value: dict[str, Any] | Sequence[Any]) -> str:
    text: str = yaml.dump(value, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True)
    return text
