"""Writer of rosbag2 directories: MCAP data with an index, and metadata.yaml (version 9)."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Final

from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from needle_bags.format.bag_metadata import (
    USUAL_QOS,
    DataFile,
    bag_information,
    channel_metadata,
    to_yaml,
    write_metadata,
)
from needle_core.errors import UserError
from needle_core.files.bag_path import METADATA_FILE
from needle_core.files.bag_topic import BagTopic
from needle_core.files.mcap_file import DISTRO_KEY, METADATA_KEY, METADATA_RECORD

LIBRARY: Final = "needle_bags"
COMPRESSIONS: Final = ("none", "zstd")
CHUNK_SIZE: Final = 2 * 2**20
_SEQUENCE_MASK: Final = 0xFFFFFFFF
_STAMP_END: Final = 12


class BagWriteError(UserError):
    """Failure to write a bag to the disk."""


class BagWriter:
    """Writer of a bag; not thread-safe.

    Parameters
    ----------
    directory : Path
        The bag; created if it does not exist.
    distribution : str
        ROS distribution of the message types in the bag.
    chunk_size : int
        Bytes after which a chunk is written.
    max_file_size : int
        Bytes of messages after which a new data file is started; 0 for never.
    compression : str
        `none` or `zstd`, applied to each chunk.
    describe_itself : bool
        Whether the data file repeats metadata.yaml, which contains the bag's name.

    Raises
    ------
    UserError
        If the directory already contains a bag or cannot be created, or the data file cannot be
        written.
    """

    def __init__(
        self,
        directory: Path,
        *,
        distribution: str = "jazzy",
        chunk_size: int = CHUNK_SIZE,
        max_file_size: int = 0,
        compression: str = "none",
        describe_itself: bool = True,
    ) -> None:
        refuse_existing_bag(directory)
        self.directory = directory
        self._distribution = distribution
        self._chunk_size = chunk_size
        self._max_file_size = max_file_size
        self._describe_itself = describe_itself
        self._compression = CompressionType[compression.upper()]
        self._topics: dict[str, BagTopic] = {}
        self._files: list[DataFile] = []
        self._custom_data: dict[str, str] = {}
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._begin_file()
        except OSError as error:
            self._remove_file()
            raise UserError(f"cannot record into {directory}: {error.strerror}") from error

    @property
    def data_file(self) -> Path:
        """The file that is being written."""
        return self.directory / self._files[-1].name

    def add_topic(self, topic: BagTopic) -> str:
        """Announce a topic; return its name."""
        self._topics[topic.name] = topic
        self._register(topic)
        return topic.name

    def write(
        self, topic: str, data: bytes, log_time: int, publish_time: int, sequence: int = 0
    ) -> None:
        """Append a serialized message.

        Parameters
        ----------
        topic : str
            Name of an announced topic.
        data : bytes
            The message as CDR with its header.
        log_time, publish_time : int
            Times of reception and sending, system clock [ns].
        sequence : int
            Sequence number of the publisher, 0 if it has none.

        Raises
        ------
        BagWriteError
            If the data cannot be written.
        """
        with self._writing():
            if self._max_file_size and self._file_bytes + len(data) > self._max_file_size:
                self._split()
            self._mcap.add_message(
                self._channels[topic], log_time, data, publish_time, sequence & _SEQUENCE_MASK
            )
        self._file_bytes += len(data)
        self._files[-1].add(topic, log_time)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a named MCAP metadata record."""
        with self._writing():
            self._mcap.add_metadata(name, dict(values))

    def set_custom_data(self, key: str, value: str) -> None:
        """Set an entry of `custom_data` in metadata.yaml."""
        self._custom_data[key] = value

    def flush(self) -> None:
        """Write the current chunk, so that a crash cannot lose it."""
        with self._writing():
            self._mcap.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and metadata.yaml.

        Raises
        ------
        BagWriteError
            If the data cannot be written.
        """
        information = self._information()
        with self._writing():
            if self._describe_itself:
                self._mcap.add_metadata(METADATA_RECORD, {METADATA_KEY: to_yaml(information)})
            self._end_file()
            write_metadata(self.directory, information)

    def abandon(self) -> None:
        """Close the unfinished data file after a `BagWriteError`; `recover` completes the bag."""
        with contextlib.suppress(OSError):
            self._stream.close()

    def update_metadata(self) -> None:
        """Rewrite metadata.yaml with custom data that was set after `close`.

        Raises
        ------
        BagWriteError
            If it cannot be written; the existing file is kept.
        """
        with self._writing():
            write_metadata(self.directory, self._information())

    def open_file(self, path: Path) -> IO[bytes]:
        """Open a new data file."""
        return path.open("xb")

    def _begin_file(self) -> None:
        name = f"{self.directory.absolute().name}_{len(self._files)}.mcap"
        self._stream = self.open_file(self.directory / name)
        # The lock lasts until the file is closed; `recover` rejects a bag that is being recorded.
        fcntl.flock(self._stream, fcntl.LOCK_EX)
        self._files.append(DataFile(name))
        self._file_bytes = 0
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[str, int] = {}
        self._mcap = Writer(
            self._stream, chunk_size=self._chunk_size, compression=self._compression
        )
        self._mcap.start(profile="ros2", library=LIBRARY)
        self._mcap.add_metadata(METADATA_RECORD, {DISTRO_KEY: self._distribution})
        for topic in self._topics.values():
            self._register(topic)
        # Detect a full or broken disk before there are messages to lose.
        self._mcap.flush()  # type: ignore[no-untyped-call]

    def _remove_file(self) -> None:
        """Remove a file that could not be started, so that the next attempt finds no bag."""
        if self._files:
            with contextlib.suppress(OSError):
                self._stream.close()
            self.data_file.unlink(missing_ok=True)

    def _end_file(self) -> None:
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._stream.close()

    def _split(self) -> None:
        self._end_file()
        self._begin_file()

    def _register(self, topic: BagTopic) -> None:
        key = (topic.type_name, topic.definition)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(
                topic.type_name, topic.encoding, topic.definition.encode()
            )
        self._channels[topic.name] = self._mcap.register_channel(
            topic.name, "cdr", self._schemas[key], channel_metadata(topic)
        )

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise BagWriteError(f"cannot write {self.data_file}: {error.strerror}") from error

    def _information(self) -> dict[str, object]:
        return bag_information(
            self._files, list(self._topics.values()), self._custom_data, self._distribution
        )


def refuse_existing_bag(directory: Path) -> None:
    """Raise a `UserError` if a directory already contains (part of) a bag, or is a file."""
    if directory.exists() and not directory.is_dir():
        raise UserError(f"cannot record into {directory}: it is a file")
    if (directory / METADATA_FILE).exists() or any(directory.glob("*.mcap")):
        raise UserError(f"{directory} already contains a bag: give a new directory")


class BagCopy(BagWriter):
    """Writer of a compressed bag that adds each topic with its first message.

    Parameters
    ----------
    directory : Path
        The new bag.
    distribution : str
        ROS distribution of its message types.
    custom_data : mapping
        Texts for metadata.yaml.

    Raises
    ------
    UserError
        If the directory already contains a bag or cannot be created.
    """

    def __init__(self, directory: Path, distribution: str, custom_data: Mapping[str, str]) -> None:
        super().__init__(directory, distribution=distribution, compression="zstd")
        self._custom_data.update(custom_data)

    def put(self, topic: BagTopic, data: bytes, log_time: int, sent: int) -> None:
        """Append a message that was received at `log_time` and sent at `sent` [ns].

        Raises
        ------
        BagWriteError
            If the data cannot be written.
        """
        if topic.name not in self._topics:
            self.add_topic(topic)
        self.write(topic.name, data, log_time, sent)


def standard_topic(name: str, type_name: str) -> BagTopic:
    """Return a topic of a standard message type."""
    store = _jazzy()
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return BagTopic(name, type_name, definition, store.hash_rihs01(type_name), (USUAL_QOS,))


def string_message(text: str) -> bytes:
    """Return a std_msgs/String as CDR."""
    name = "std_msgs/msg/String"
    store = _jazzy()
    return bytes(store.serialize_cdr(store.types[name](data=text), name))


@functools.cache
def _jazzy() -> Typestore:
    """Return Jazzy's types, loaded only when needed because this takes 0.1 s."""
    return get_typestore(Stores.ROS2_JAZZY)


def stamp_of(data: bytes) -> int:
    """Return the stamp [ns] of a message (CDR) that begins with a header.

    Raises
    ------
    UserError
        If the message is too short.
    """
    if len(data) < _STAMP_END:
        raise UserError(f"a message of {len(data)} bytes has no header with a stamp")
    order = "<" if data[1] & 1 else ">"
    sec, nanosec = struct.unpack_from(f"{order}iI", data, 4)
    return int(sec) * 10**9 + int(nanosec)
