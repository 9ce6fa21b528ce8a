"""Reads an MCAP file by its index: all that was recorded or an error, within bounds of memory.

The format: https://mcap.dev/spec. The index is checked against its checksum, every chunk against
its checksum and the index, and what was read against the counts in the index.
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Final, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Message,
    Schema,
    Statistics,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from needle_common.files.file_access import open_regular

RECORD_HEADER: Final = struct.Struct("<BQ")
FOOTER_SIZE: Final = RECORD_HEADER.size + 20
# What bytes that are not what they should be make a parser raise.
UNREADABLE: Final = (
    ValueError,
    struct.error,
    McapError,
    LookupError,
    OverflowError,
    RuntimeError,
    zstandard.ZstdError,
)
# Largest chunk, and largest sum of chunks that overlap in time, taken into memory [B].
CHUNK_LIMIT: Final = 2**29
OVERLAP_LIMIT: Final = 2**30
SUMMARY_LIMIT: Final = 2**27
# Times [ns] are signed in ROS 2.
TIME_LIMIT: Final = 2**63
_MESSAGE: Final = struct.Struct("<HIQQ")
_DEFINITIONS: Final[dict[int, type[Channel] | type[Schema]]] = {
    Opcode.CHANNEL: Channel,
    Opcode.SCHEMA: Schema,
}


class BrokenMcapError(Exception):
    """A file is not what its index says, or has none; the message says how."""


class _Part(NamedTuple):
    """A chunk, or a message outside of chunks (without an index): times [ns], and where it is."""

    first: int
    offset: int
    last: int
    length: int
    size: int
    chunk: ChunkIndex | None


class Index(NamedTuple):
    """Index at a file's end: its contents, where it begins, whether a checksum vouches for it."""

    records: Summary
    start: int
    is_checked: bool

    def counts(self) -> dict[str, int]:
        """Return messages by topic."""
        found: Counter[str] = Counter()
        if self.records.statistics is not None:
            for number, count in self.records.statistics.channel_message_counts.items():
                found[self.records.channels[number].topic] += count
        return dict(found)


def read_index(data: bytes, size: int) -> Index:
    """Return the index that ends a file.

    Parameters
    ----------
    data : bytes
        The last part of the file, `SUMMARY_LIMIT` bytes if it has them.
    size : int
        The file's.

    Raises
    ------
    BrokenMcapError
        If there is none, or it is damaged.
    """
    if not data.endswith(MCAP0_MAGIC) or len(data) < FOOTER_SIZE + len(MCAP0_MAGIC):
        raise BrokenMcapError("it has no end: the recording was cut off")
    end = len(data) - FOOTER_SIZE - len(MCAP0_MAGIC)
    if RECORD_HEADER.unpack_from(data, end) != (Opcode.FOOTER, 20):
        raise BrokenMcapError("its footer is damaged")
    footer = Footer.read(ReadDataStream(BytesIO(data[end + RECORD_HEADER.size :])))
    if not footer.summary_start:
        raise BrokenMcapError("it has no index")
    begin = footer.summary_start - (size - len(data))
    if begin < 0 or begin > end:
        raise BrokenMcapError("its index is not where its footer says, or too large")
    section = data[begin : len(data) - len(MCAP0_MAGIC) - 4]
    if footer.summary_crc and zlib.crc32(section) != footer.summary_crc:
        raise BrokenMcapError("the checksum of its index is wrong")
    try:
        records = NonSeekingReader(BytesIO(MCAP0_MAGIC + data[begin:])).get_summary()
        index = Index(records or Summary(), footer.summary_start, bool(footer.summary_crc))
        index.counts()
    except UNREADABLE as error:
        raise BrokenMcapError("its index is damaged") from error
    return index


def decompressed(data: bytes, compression: str, size: int) -> bytes:
    """Return what `size` bytes were compressed into `data`.

    Raises
    ------
    ValueError, RuntimeError, zstandard.ZstdError
        If it is damaged, not of that size, or above `CHUNK_LIMIT`.
    """
    if size > CHUNK_LIMIT:
        raise ValueError(f"a chunk holds {size} bytes, {CHUNK_LIMIT} at most are read")
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
            plain = stream.read(size + 1)
    elif compression == "lz4":
        plain = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
    elif not compression:
        plain = data
    else:
        raise ValueError(f"a chunk is compressed as {compression[:20]!r}")
    if len(plain) != size:
        raise ValueError("a chunk is not of the size that it says")
    return plain


def records_of(chunk: Chunk) -> list[McapRecord]:
    """Return the records in a chunk, checked against its checksum if it has one.

    Raises
    ------
    UNREADABLE
        If it is damaged.
    """
    plain = decompressed(chunk.data, chunk.compression, chunk.uncompressed_size)
    if chunk.uncompressed_crc not in (0, zlib.crc32(plain)):
        raise ValueError("its checksum is wrong")
    records: list[McapRecord] = []
    view, position = memoryview(plain), 0
    while position < len(plain):
        opcode, length = RECORD_HEADER.unpack_from(plain, position)
        position += RECORD_HEADER.size
        body = view[position : position + length]
        position += length
        if len(body) < length:
            raise ValueError("its last record is cut off")
        # mcap's own parser takes eight calls for a message, and messages are nearly all there is.
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
            data = bytes(body[_MESSAGE.size :])
            records.append(Message(channel, log_time, data, publish_time, sequence))
        elif opcode in _DEFINITIONS:
            records.append(_DEFINITIONS[opcode].read(ReadDataStream(BytesIO(body))))
    return records


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
        self._stream = open_regular(path)
        try:
            self._size = os.fstat(self._stream.fileno()).st_size
            self._index = self._open()
            self.summary = self._index.records
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

    def counts(self) -> dict[str, int]:
        """Return messages by topic."""
        return self._index.counts()

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of each type's definition."""
        schemas = self.summary.schemas.values()
        return {schema.name: (schema.encoding, schema.data.decode()) for schema in schemas}

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

    def _open(self) -> Index:
        if self._read(0, len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise BrokenMcapError("it does not begin as an MCAP file")
        begin = max(0, self._size - SUMMARY_LIMIT)
        self._stream.seek(max(begin, self._size - 2**16))
        try:
            index = read_index(self._stream.read(), self._size)
        except BrokenMcapError:  # or longer than that
            index = read_index(self._read(begin, self._size - begin), self._size)
        summary, told = index.records, index.records.statistics
        if told is None:
            raise BrokenMcapError("its index does not say how many messages there are")
        if told.message_count != sum(told.channel_message_counts.values()):
            raise BrokenMcapError("its index contradicts itself")
        if told.message_count and told.message_end_time >= TIME_LIMIT:
            raise BrokenMcapError("its times lie beyond the year 2262")
        for channel in summary.channels.values():
            if channel.schema_id and channel.schema_id not in summary.schemas:
                raise BrokenMcapError(f"it does not define the type of {channel.topic}")
        self.statistics: Statistics = told
        return index

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
        while position < self._index.start:
            head = self._read(position, RECORD_HEADER.size + _MESSAGE.size)
            if len(head) < RECORD_HEADER.size:
                break
            opcode, length = RECORD_HEADER.unpack_from(head)
            length += RECORD_HEADER.size
            if opcode == Opcode.MESSAGE:
                if length < len(head):
                    raise BrokenMcapError("a message's length is wrong")
                channel, _, log_time, publish_time = _MESSAGE.unpack_from(head, RECORD_HEADER.size)
                self._check(log_time, publish_time)
                found.append(_Part(log_time, position, log_time, length, length, None))
                seen[channel] += 1
            elif opcode == Opcode.CHUNK:
                raise BrokenMcapError("its index does not know its chunks")
            position += length
        if position != self._index.start:
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
