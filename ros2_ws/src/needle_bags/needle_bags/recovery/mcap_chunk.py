"""One chunk of an MCAP file: found although its header may be damaged, and checked.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator, Sequence
from typing import Any, Final

from mcap._chunk_builder import ChunkBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, McapRecord, Message, Schema

from needle_common.files.mcap_file import RECORD_HEADER, TIME_LIMIT, UNREADABLE, records_of

# message_start_time, message_end_time, uncompressed_size, uncompressed_crc, length of compression
CHUNK_HEADER: Final = struct.Struct("<QQQII")
SIZE: Final = struct.Struct("<Q")
_COMPRESSIONS: Final = ("", "zstd", "lz4")


@dataclasses.dataclass(frozen=True)
class StoredChunk:
    """A chunk that can be read.

    Attributes
    ----------
    start, end : int
        Its record in the file.
    data_start : int
        Where its content begins.
    compression : str
        Empty, `zstd` or `lz4`.
    size, crc : int
        Bytes and checksum of its content, uncompressed.
    is_mended : bool
        Whether its header is not what its content is.
    """

    start: int
    end: int
    data_start: int
    compression: str
    size: int
    crc: int
    is_mended: bool = False

    @property
    def is_vouched(self) -> bool:
        """Tell whether a checksum says that its content is what was written."""
        return bool(self.crc)

    def records(self, data: Any) -> list[McapRecord]:
        """Return what is in it.

        Raises
        ------
        UNREADABLE
            If it is damaged.
        """
        stored = bytes(data[self.data_start : self.end])
        return records_of(Chunk(self.compression, stored, 0, 0, self.crc, self.size))

    def messages(self, data: Any) -> Iterator[Message]:
        """Yield the messages in it."""
        for record in self.records(data):
            if isinstance(record, Message) and record.log_time < TIME_LIMIT:
                yield record


def find_chunk(
    data: Any, position: int, limit: int, index: ChunkIndex | None
) -> StoredChunk | None:
    """Return the chunk at a position if its content is whole.

    Parameters
    ----------
    data : mmap or bytes
        The file.
    position, limit : int
        Where its record begins, and the data end.
    index : ChunkIndex or None
        What the file's index says of it, if it says something.
    """
    names = position + RECORD_HEADER.size + CHUNK_HEADER.size
    if names + SIZE.size > limit:
        return None
    (length,) = SIZE.unpack_from(data, position + 1)
    told = position + RECORD_HEADER.size + length
    first, last, size, crc, name_length = CHUNK_HEADER.unpack_from(
        data, position + RECORD_HEADER.size
    )
    name = bytes(data[names : names + min(name_length, 8)]).decode(errors="replace")
    tries: list[tuple[str, int, int]] = []  # compression, uncompressed size, end
    if name in _COMPRESSIONS and name_length <= 8:
        content = names + name_length + SIZE.size
        (stored,) = SIZE.unpack_from(data, content - SIZE.size)
        for end in (told, content + stored):
            tries += [(name, size, end)] if name else [(name, end - content, end)]
    if index is not None:
        end = names + len(index.compression) + SIZE.size + index.compressed_size
        tries.append((index.compression, index.uncompressed_size, end))
        if (first, last) != (index.message_start_time, index.message_end_time):
            first = last + 1
    for compression, plain, end in tries:
        content = names + len(compression) + SIZE.size
        if not content <= end <= limit:
            continue
        (stored,) = SIZE.unpack_from(data, content - SIZE.size)
        agrees = (name, size, told, content + stored) == (compression, plain, end, end)
        agrees = agrees and data[position] == Opcode.CHUNK
        chunk = StoredChunk(
            position, end, content, compression, plain, crc, not agrees or first > last
        )
        try:
            times = [m.log_time for m in chunk.records(data) if isinstance(m, Message)]
        except UNREADABLE:
            continue
        if times and (min(times), max(times)) != (first, last):
            chunk = dataclasses.replace(chunk, is_mended=True)
        return chunk
    return None


def chunk_end(data: Any, position: int, index: ChunkIndex | None) -> int | None:
    """Return where a chunk ends that is damaged, None if its own two lengths contradict each other.

    Parameters are those of `find_chunk`.
    """
    if index is not None:
        return int(position + index.chunk_length)
    start = position + RECORD_HEADER.size
    name_length = CHUNK_HEADER.unpack_from(data, start)[4]
    content = start + CHUNK_HEADER.size + name_length + SIZE.size
    told = int(start + SIZE.unpack_from(data, position + 1)[0])
    return told if content + SIZE.unpack_from(data, content - SIZE.size)[0] == told else None


def index_of(records: Sequence[McapRecord]) -> dict[int, list[tuple[int, int]]]:
    """Return the message indexes of a chunk with these records: channel to (log time, offset)."""
    builder = ChunkBuilder()
    for record in records:
        if isinstance(record, Schema):
            builder.add_schema(record)
        elif isinstance(record, Channel):
            builder.add_channel(record)
        elif isinstance(record, Message):
            builder.add_message(record)
    return {number: index.records for number, index in builder.message_indices.items()}
