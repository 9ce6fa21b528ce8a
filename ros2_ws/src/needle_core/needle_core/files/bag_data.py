"""Bag data other than plain MCAP: SQLite files, and compressed files or messages."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import zstandard
from rosbags.interfaces import MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from needle_core.files.file_access import open_regular
from needle_core.files.mcap_file import TIME_LIMIT


class SqliteData:
    """SQLite file with the interface of `McapFile`; it has no send times."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and the last message [ns]; None in an empty file."""
        if not self._reader.message_count:
            return None
        return self._reader.start_time, self._reader.end_time - 1

    def counts(self) -> Mapping[str, int]:
        """Return the number of messages by topic."""
        found: Counter[str] = Counter()
        for connection in self._reader.connections:
            found[connection.topic] += connection.msgcount
        return found

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of the definition of each type."""
        kinds = {MessageDefinitionFormat.MSG: "ros2msg", MessageDefinitionFormat.IDL: "ros2idl"}
        return {
            connection.msgtype: (kinds[connection.msgdef.format], connection.msgdef.data)
            for connection in self._reader.connections
            if connection.msgdef.format in kinds
        }

    def read(
        self, topics: Collection[str], start: int, stop: int
    ) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, log time, publish time [ns] and data, in order of log time."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        # TIME_LIMIT exceeds SQLite's integers.
        end = stop if stop < TIME_LIMIT else None
        if connections:
            for connection, log_time, data in self._reader.messages(connections, start, end):
                yield connection.topic, log_time, log_time, bytes(data)


def is_compressed(data: bytes) -> bool:
    """Return whether a message is compressed; CDR never starts with these bytes."""
    return data.startswith(zstandard.FRAME_HEADER)


def unpack(data: bytes) -> bytes:
    """Return the data of a compressed message.

    Raises
    ------
    zstandard.ZstdError
        If it is damaged.
    """
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return bytes(stream.read())


def unpack_file(path: Path, folder: Path) -> Path:
    """Decompress a data file into a folder; return its path.

    Raises
    ------
    zstandard.ZstdError, OSError
        If it is damaged.
    """
    plain = folder / path.stem
    with open_regular(path) as packed, plain.open("xb") as stream:
        reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        shutil.copyfileobj(reader, stream)
    return plain
