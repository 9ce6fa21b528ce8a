"""Records of an MCAP file, and the index at its end, read within bounds of memory.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
import zlib
from io import BytesIO
from typing import Any, BinaryIO, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

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
# Largest chunk, and largest index, taken into memory [B].
CHUNK_LIMIT: Final = 2**29
SUMMARY_LIMIT: Final = 2**27
# Times [ns] are signed in ROS 2.
TIME_LIMIT: Final = 2**63
MESSAGE: Final = struct.Struct("<HIQQ")
_RECORDS: Final[dict[int, Any]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
}


class BrokenMcapError(Exception):
    """A file is not what its index says, or has none; the message says how."""


def find_index(stream: BinaryIO) -> tuple[Summary, int]:
    """Return the index that ends a file, and where it begins.

    Parameters
    ----------
    stream : file
        The file.

    Raises
    ------
    BrokenMcapError
        If there is none, or it is damaged.
    """
    size = stream.seek(0, os.SEEK_END)
    try:
        return _read_index(stream, size, 2**16)
    except BrokenMcapError:  # or longer than that
        return _read_index(stream, size, SUMMARY_LIMIT)


def _read_index(stream: BinaryIO, size: int, limit: int) -> tuple[Summary, int]:
    stream.seek(max(0, size - limit))
    data = stream.read()
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
    except UNREADABLE as error:
        raise BrokenMcapError("its index is damaged") from error
    return records or Summary(), footer.summary_start


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
        record = parse_record(opcode, body)
        if record is not None:
            records.append(record)
    return records


def parse_record(opcode: int, body: memoryview) -> Any:
    """Return a record of the data; None for one that no reader needs.

    Raises
    ------
    UNREADABLE
        If it is damaged.
    """
    # mcap's own parser takes eight calls for a message, and messages are nearly all there is.
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = MESSAGE.unpack_from(body)
        data = bytes(body[MESSAGE.size :])
        return Message(channel, log_time, data, publish_time, sequence)
    parser = _RECORDS.get(opcode)
    return None if parser is None else parser.read(ReadDataStream(BytesIO(body)))
