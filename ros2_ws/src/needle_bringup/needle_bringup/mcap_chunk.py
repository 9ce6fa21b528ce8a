"""One chunk of an MCAP file: its header, checksum and the records in it.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import dataclasses
import itertools
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, Final

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Schema
from mcap.stream_reader import get_chunk_data_stream

RECORD_HEADER: Final = struct.Struct("<BQ")
# message_start_time, message_end_time, uncompressed_size, uncompressed_crc, length of compression
CHUNK_HEADER: Final = struct.Struct("<QQQII")
SIZE: Final = struct.Struct("<Q")
# What bytes that are not what they should be make a parser raise.
UNREADABLE: Final = (ValueError, struct.error, McapError, IndexError)
_MESSAGE: Final = struct.Struct("<HIQQ")
_MESSAGE_HEADER: Final = RECORD_HEADER.size + _MESSAGE.size

Definition = Schema | Channel


@dataclasses.dataclass
class ChunkContent:
    """A chunk's index entry, and what is in it.

    Attributes
    ----------
    index : ChunkIndex
        As the summary has it.
    entries : dict of int to list of (int, int)
        Channel to (log time [ns], offset in the chunk) of its messages; emptied where the file has
        them, so that only what has to be written again is kept.
    counts : dict of int to int
        Messages for each channel.
    """

    index: ChunkIndex
    entries: dict[int, list[tuple[int, int]]]
    counts: dict[int, int]

    @property
    def end(self) -> int:
        """Where the chunk's record ends, and its message index begins."""
        return int(self.index.chunk_start_offset + self.index.chunk_length)

    @property
    def is_indexed(self) -> bool:
        """Whether the file has the whole message index."""
        return set(self.index.message_index_offsets) == set(self.counts)

    def write_index(self, start: int) -> bytes:
        """Return the message index, and take note that it is at an offset of the file."""
        records = {c: index_record(c, entries) for c, entries in self.entries.items()}
        position = start
        for channel, record in records.items():
            self.index.message_index_offsets[channel] = position
            position += len(record)
        self.index.message_index_length = position - start
        return b"".join(records.values())

    def count(self, channel: int, time: int, offset: int) -> None:
        """Count a message of the chunk."""
        self.entries.setdefault(channel, []).append((time, offset))
        self.counts[channel] = self.counts.get(channel, 0) + 1


@dataclasses.dataclass
class HalfChunk:
    """The chunk that was being written: the file ends within it.

    Attributes
    ----------
    start : int
        Its offset.
    data_end : int
        Where the last whole message ends.
    content : ChunkContent
        What it holds if it is cut there.
    crc : int
        Checksum of that part.
    """

    start: int
    data_end: int
    content: ChunkContent
    crc: int


def read_chunk(data: Any, position: int, length: int) -> tuple[ChunkContent, list[Definition]]:
    """Read and check the chunk at a position; return its content and the definitions in it.

    Raises
    ------
    ValueError
        If it is damaged.
    """
    start = position + RECORD_HEADER.size
    if length < RECORD_HEADER.size + CHUNK_HEADER.size + SIZE.size:
        raise ValueError("the chunk is too short")
    first, last, size, crc, name_length = CHUNK_HEADER.unpack_from(data, start)
    names = start + CHUNK_HEADER.size
    if name_length > 16 or first > last:
        raise ValueError("the chunk's header is wrong")
    compression = bytes(data[names : names + name_length]).decode()
    data_start = names + name_length + SIZE.size
    (stored,) = SIZE.unpack_from(data, names + name_length)
    if data_start + stored != position + length:
        raise ValueError("the chunk's sizes contradict each other")
    stored_data = bytes(data[data_start : position + length])
    content = _decompressed(Chunk(compression, stored_data, last, first, crc, size))
    if len(content) != size:
        raise ValueError("the chunk's size is wrong")
    index = ChunkIndex(length, position, compression, stored, last, 0, {}, first, size)
    chunk = ChunkContent(index, {}, {})
    definitions: list[Definition] = []
    end = 0
    for opcode, offset, end in _records(content):  # noqa: B007  (end is used below)
        if opcode == Opcode.MESSAGE:
            channel, _, time, _ = _MESSAGE.unpack_from(content, offset + RECORD_HEADER.size)
            chunk.count(channel, time, offset)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            definitions.append(read_definition(content, offset))
    if end != size:
        raise ValueError("the chunk ends within a record")
    return chunk, definitions


def read_half_chunk(
    data: Any, position: int, length: int
) -> tuple[HalfChunk | None, list[Definition]]:
    """Return what is whole in the file's last chunk if the chunk is not, and its definitions.

    None if nothing is, or if it is compressed: then its beginning cannot be checked.
    """
    start = position + RECORD_HEADER.size
    data_start = start + CHUNK_HEADER.size + SIZE.size
    if data_start > len(data):
        return None, []
    first, last, size, _, name_length = CHUNK_HEADER.unpack_from(data, start)
    if name_length or position + length != data_start + size:
        return None, []
    part = bytes(data[data_start : position + length])
    content = ChunkContent(ChunkIndex(0, position, "", 0, 0, 0, {}, 0, 0), {}, {})
    definitions: list[Definition] = []
    found: list[tuple[int, int, int]] = []  # channel, log time, offset of each message
    whole = 0
    try:
        for opcode, offset, end in _records(part):
            if opcode == Opcode.MESSAGE:
                channel, _, time, _ = _MESSAGE.unpack_from(part, offset + RECORD_HEADER.size)
                if not first <= time <= last:
                    break
                found.append((channel, time, offset))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.append(read_definition(part, offset))
            else:
                break
            whole = end
    except UNREADABLE:
        pass  # what came before it is whole
    ends_in_zeros = whole < len(part) and not any(part[whole + _MESSAGE_HEADER :])
    if position + length <= len(data) and not ends_in_zeros:
        return None, []  # it is not cut but damaged, nobody knows where
    if found and ends_in_zeros and not part[whole - 1]:
        whole = found.pop()[2]  # the message may end in what a power cut left as zeros
    if not found:
        return None, definitions
    for channel, time, offset in found:
        content.count(channel, time, offset)
    times = [time for _, time, _ in found]
    index = content.index
    index.message_start_time, index.message_end_time = min(times), max(times)
    index.compressed_size = index.uncompressed_size = whole
    index.chunk_length = data_start + whole - position
    return HalfChunk(position, data_start + whole, content, zlib.crc32(part[:whole])), definitions


def _decompressed(chunk: Chunk) -> bytes:
    """Return a chunk's content, checked."""
    try:
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    # Each decompressor has exceptions of its own.
    except Exception as error:
        raise ValueError(str(error)) from error
    return stream.read(length)


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, offset, end) of every whole record in a chunk's content."""
    position = 0
    while position + RECORD_HEADER.size <= len(content):
        opcode, length = RECORD_HEADER.unpack_from(content, position)
        end = position + RECORD_HEADER.size + length
        if end > len(content):
            return
        yield opcode, position, end
        position = end


def index_record(channel: int, entries: list[tuple[int, int]]) -> bytes:
    """Return the message index of one channel in a chunk."""
    numbers = itertools.chain.from_iterable(entries)
    size = 2 * SIZE.size * len(entries)
    return RECORD_HEADER.pack(Opcode.MESSAGE_INDEX, 6 + size) + struct.pack(
        f"<HI{2 * len(entries)}Q", channel, size, *numbers
    )


def read_definition(content: bytes, offset: int) -> Definition:
    """Return the schema or channel whose record begins at an offset.

    Raises
    ------
    ValueError, struct.error, McapError
        If it is damaged.
    """
    opcode, length = RECORD_HEADER.unpack_from(content, offset)
    start = offset + RECORD_HEADER.size
    body = ReadDataStream(BytesIO(content[start : start + length]))
    if opcode == Opcode.CHANNEL:
        channel: Channel = Channel.read(body)
        return channel
    schema: Schema = Schema.read(body)
    schema.data.decode()  # readers take it for text
    return schema
