"""Reads an MCAP file by its index: all that was recorded or an error, within bounds of memory.

The format: https://mcap.dev/spec. The index is checked against its checksum, every chunk against
its checksum and the index, and what was read against the counts in the index.
"""

from __future__ import annotations

import heapq
import os
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Message, Metadata, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from needle_core.errors import UserError
from needle_core.files.file_access import open_regular
from needle_core.files.mcap_records import (
    MESSAGE,
    RECORD_HEADER,
    SUMMARY_LIMIT,
    TIME_LIMIT,
    UNREADABLE,
    BrokenMcapError,
    find_index,
    parse_record,
    records_of,
)

# Largest sum of chunks that overlap in time, taken into memory [B].
OVERLAP_LIMIT: Final = 2**30


class _Part(NamedTuple):
    """A chunk, or a message outside of chunks (without an index): times [ns], and where it is."""

    first: int
    offset: int
    last: int
    length: int
    size: int
    chunk: ChunkIndex | None


class McapFile:
    """A whole MCAP file, open for reading.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    BrokenMcapError
        If it is not whole.
    UserError
        If it is compressed in a way that is not read here.
    OSError
        If it cannot be read.

    Attributes
    ----------
    summary : Summary
        What it says is in it.
    statistics : Statistics
        Its counts and times.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stream = open_regular(path)
        try:
            self._size = os.fstat(self._stream.fileno()).st_size
            self.summary, self._end = self._open()
            self._parts = [
                _Part(
                    c.message_start_time,
                    c.chunk_start_offset,
                    c.message_end_time,
                    c.chunk_length,
                    c.uncompressed_size,
                    c,
                )
                for c in self.summary.chunk_indexes
            ] or self._find_messages()
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and the last message [ns]; None in an empty file."""
        told = self.statistics
        return (told.message_start_time, told.message_end_time) if told.message_count else None

    def counts(self) -> Counter[str]:
        """Return messages by topic."""
        found: Counter[str] = Counter()
        for number, count in self.statistics.channel_message_counts.items():
            found[self.summary.channels[number].topic] += count
        return found

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of each type's definition."""
        schemas = self.summary.schemas.values()
        return {schema.name: (schema.encoding, schema.data.decode()) for schema in schemas}

    def topics(self) -> list[dict[str, Any]]:
        """Return what metadata.yaml has of each topic below `topics_with_message_count`."""
        counts, schemas = self.statistics.channel_message_counts, self.summary.schemas
        return [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": schemas[channel.schema_id].name if channel.schema_id else "",
                    "serialization_format": channel.message_encoding,
                    "offered_qos_profiles": channel.metadata.get("offered_qos_profiles"),
                    "type_description_hash": channel.metadata.get("topic_type_hash"),
                },
                "message_count": counts.get(channel.id, 0),
            }
            for channel in self.summary.channels.values()
        ]

    def metadata(self) -> list[Metadata]:
        """Return the metadata records.

        Raises
        ------
        BrokenMcapError
            If one is damaged, or they take more than `SUMMARY_LIMIT`.
        """
        indexes = self.summary.metadata_indexes
        if sum(index.length for index in indexes) > SUMMARY_LIMIT:
            raise BrokenMcapError("its metadata records are too large")
        found = []
        for index in indexes:
            record = memoryview(self._read(index.offset, index.length))
            try:
                found.append(parse_record(Opcode.METADATA, record[RECORD_HEADER.size :]))
            except UNREADABLE as error:
                raise BrokenMcapError("a metadata record is damaged") from error
        return found

    def read(
        self, topics: Collection[str], start: int = 0, stop: int = TIME_LIMIT
    ) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, log time, publish time [ns] and data: start <= log time < stop, in order.

        Raises
        ------
        BrokenMcapError
            If the file has other messages than its index says.
        """
        names = {number: channel.topic for number, channel in self.summary.channels.items()}
        waiting = sorted(
            (part for part in self._parts if part.last >= start),
            key=lambda part: (part.first, part.offset),
            reverse=True,
        )
        is_complete = len(waiting) == len(self._parts)
        seen: Counter[int] = Counter()
        heap: list[tuple[int, int, Message]] = []
        number = held = 0
        while heap or waiting:
            while waiting and (not heap or waiting[-1].first <= heap[0][0]):
                if waiting[-1].first >= stop:
                    is_complete = False
                    waiting.clear()
                    break
                part = waiting.pop()
                held = (held if heap else 0) + part.size
                if held > OVERLAP_LIMIT:
                    raise BrokenMcapError("too many of its chunks are of the same time")
                for message in self._messages(part):
                    seen[message.channel_id] += 1
                    wanted = names[message.channel_id] in topics
                    if wanted and start <= message.log_time < stop:
                        number += 1
                        heapq.heappush(heap, (message.log_time, number, message))
            if heap:
                message = heapq.heappop(heap)[2]
                name = names[message.channel_id]
                yield name, message.log_time, message.publish_time, message.data
        if is_complete:
            self._compare(seen)

    def _open(self) -> tuple[Summary, int]:
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BrokenMcapError("it does not begin as an MCAP file")
        summary, end = find_index(self._stream)
        told = summary.statistics
        for chunk in summary.chunk_indexes:
            if chunk.compression not in ("", "zstd", "lz4"):
                raise UserError(
                    f"{self._path}: its compression {chunk.compression[:20]!r} is not read here"
                )
        if told is None:
            raise BrokenMcapError("its index does not say how many messages there are")
        counts = told.channel_message_counts
        if (
            told.message_count != sum(counts.values())
            or not counts.keys() <= summary.channels.keys()
        ):
            raise BrokenMcapError("its index contradicts itself")
        if told.message_count and told.message_end_time >= TIME_LIMIT:
            raise BrokenMcapError("its times lie beyond the year 2262")
        for channel in summary.channels.values():
            if channel.schema_id and channel.schema_id not in summary.schemas:
                raise BrokenMcapError(f"it does not define the type of {channel.topic}")
        self.statistics: Statistics = told
        return summary, end

    def _read(self, offset: int, size: int) -> bytes:
        self._stream.seek(offset)
        return self._stream.read(size)

    def _messages(self, part: _Part) -> Iterator[Message]:
        """Yield the messages of a part, in the order they have in it."""
        start, length, index = part.offset, part.length, part.chunk
        if start + length > self._size:
            raise BrokenMcapError("a chunk is not where its index says")
        data = self._read(start, length)
        if index is None:
            stream = ReadDataStream(BytesIO(data[RECORD_HEADER.size :]))
            yield Message.read(stream, length - RECORD_HEADER.size)
            return
        try:
            if RECORD_HEADER.unpack_from(data) != (Opcode.CHUNK, length - RECORD_HEADER.size):
                raise BrokenMcapError(f"there is no chunk at byte {start}")
            chunk = Chunk.read(ReadDataStream(BytesIO(data[RECORD_HEADER.size :])))
            told = (chunk.compression, len(chunk.data), chunk.uncompressed_size)
            times = (chunk.message_start_time, chunk.message_end_time)
            if told != (index.compression, index.compressed_size, index.uncompressed_size) or (
                times != (index.message_start_time, index.message_end_time)
            ):
                raise BrokenMcapError(f"the chunk at byte {start} is not what the index says")
            records = records_of(chunk)
        except UNREADABLE as error:
            raise BrokenMcapError(f"the chunk at byte {start} is damaged: {error}") from error
        for record in records:
            if isinstance(record, Message):
                self._check(record.log_time, record.publish_time)
                if record.channel_id not in self.summary.channels:
                    raise BrokenMcapError("a message is of no known topic")
                if not times[0] <= record.log_time <= times[1]:
                    raise BrokenMcapError("a message is not of its chunk's time")
                yield record

    def _check(self, log_time: int, publish_time: int) -> None:
        told = self.statistics
        if not told.message_start_time <= log_time <= told.message_end_time:
            raise BrokenMcapError("a message is not of the file's time")
        if publish_time >= TIME_LIMIT:
            raise BrokenMcapError("its times lie beyond the year 2262")

    def _find_messages(self) -> list[_Part]:
        """Return the messages of a file without chunks."""
        found: list[_Part] = []
        seen: Counter[int] = Counter()
        position = len(MCAP0_MAGIC)
        while position < self._end:
            head = self._read(position, RECORD_HEADER.size + MESSAGE.size)
            if len(head) < RECORD_HEADER.size:
                break
            opcode, length = RECORD_HEADER.unpack_from(head)
            length += RECORD_HEADER.size
            if opcode == Opcode.MESSAGE:
                if length < len(head):
                    raise BrokenMcapError("a message's length is wrong")
                channel, _, log_time, publish_time = MESSAGE.unpack_from(head, RECORD_HEADER.size)
                self._check(log_time, publish_time)
                found.append(_Part(log_time, position, log_time, length, length, None))
                seen[channel] += 1
            elif opcode == Opcode.CHUNK:
                raise BrokenMcapError("its index does not know its chunks")
            position += length
        if position != self._end:
            raise BrokenMcapError("a record's length is wrong")
        self._compare(seen)
        return found

    def _compare(self, seen: Counter[int]) -> None:
        told = Counter(self.statistics.channel_message_counts)
        if seen != +told:
            raise BrokenMcapError(
                f"it holds {sum(seen.values())} messages, its index tells of "
                f"{sum(told.values())}, or of others"
            )
