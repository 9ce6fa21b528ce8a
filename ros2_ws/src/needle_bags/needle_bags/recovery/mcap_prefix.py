"""Everything before the first damage of an MCAP file, and the time of what follows it.

The format: https://mcap.dev/spec. mcap's `StreamReader` follows lengths within a record beyond the
record's end, and passes over bytes that are no record. Here both are damage.
"""

from __future__ import annotations

import contextlib
import mmap
import re
import struct
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, BinaryIO, Final, cast

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, Writer

from needle_bags.format.bag_writer import CHUNK_SIZE, LIBRARY
from needle_core.files.bag_data import is_packed, unpack
from needle_core.files.file_access import open_regular
from needle_core.files.mcap_records import (
    CHUNK_LIMIT,
    RECORD_HEADER,
    TIME_LIMIT,
    UNREADABLE,
    BrokenMcapError,
    find_index,
    parse_record,
    records_of,
)

# Schema, channel, message, chunk, message index, attachment, metadata and the end of the data.
_DATA: Final = frozenset((3, 4, 5, 6, 7, 9, 12, 15))
# The record of a chunk below 4 GB, up to its content: opcode, length; times, size and checksum;
# compression; length of the content.
_CHUNK: Final = re.compile(rb"\x06.{4}\0{4}.{28}(\0{4}|\x04\0{3}zstd|\x03\0{3}lz4).{8}", re.DOTALL)


class _CutOffError(ValueError):
    """The file ends within a record or in zeros, as a kill or a power cut leaves it."""


class PrefixCopy:
    """A copy of all records before the first that is damaged, not finished yet.

    Parameters
    ----------
    source : Path
        The damaged file.
    target : file
        Takes the copy.

    Raises
    ------
    OSError
        If the disk refuses it.

    Attributes
    ----------
    writer : Writer
        Of the copy.
    end : int
        Where the damage begins [B].
    reason : str
        The kind of damage; empty if the data end as they should.
    is_cut : bool
        Whether the file seems to end there.
    messages, last : int
        Messages in the copy, and their latest log time [ns].
    """

    def __init__(self, source: Path, target: IO[bytes]) -> None:
        self.writer = Writer(target, CHUNK_SIZE)
        self.end = self.messages = self.last = 0
        self.reason = ""
        self.is_cut = False
        self._schemas = {0: 0}
        self._channels: dict[int, int] = {}
        with open_regular(source) as stream:
            self._span = _span(stream) or (0, TIME_LIMIT - 1)
            try:
                for end, records in _records(stream, source.stat().st_size):
                    for record in records:
                        self._put(record)
                    self.end = end
            # Lengths that point outside, texts that are not UTF-8, wrong checksums.
            except UNREADABLE as error:
                is_told = type(error) in (ValueError, _CutOffError)
                self.reason = str(error) if is_told else "a record is damaged"
                self.is_cut = isinstance(error, _CutOffError)

    def _put(self, record: Any) -> None:
        match record:
            case Header():
                self.writer.start(record.profile, LIBRARY)
            case Schema() if record.id not in self._schemas:
                record.data.decode()  # readers take it for text
                self._schemas[record.id] = self.writer.register_schema(
                    record.name, record.encoding, record.data
                )
            case Channel() if record.id not in self._channels:
                self._channels[record.id] = self.writer.register_channel(
                    record.topic,
                    record.message_encoding,
                    self._schemas[record.schema_id],
                    record.metadata,
                )
            case Message():
                channel, sent = self._channels[record.channel_id], record.publish_time
                if not self._span[0] <= record.log_time <= self._span[1] or sent >= TIME_LIMIT:
                    raise ValueError("a message is not of the recording's time")
                if is_packed(record.data):
                    unpack(record.data)
                self.writer.add_message(
                    channel, record.log_time, record.data, sent, record.sequence
                )
                self.messages += 1
                self.last = max(self.last, record.log_time)
            case Metadata():
                self.writer.add_metadata(record.name, record.metadata)
            case Attachment():
                self.writer.add_attachment(**vars(record))


def _records(stream: IO[bytes], size: int) -> Iterator[tuple[int, list[Any]]]:
    """Yield the records of the data, those of a chunk at once, and the offset behind them.

    Raises
    ------
    UNREADABLE
        If the next record is damaged.
    """
    stream.seek(0)
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise ValueError("it does not begin as an MCAP file")
    opcode = 0
    while opcode != Opcode.DATA_END:
        known = _DATA if opcode else (Opcode.HEADER,)
        head = stream.read(RECORD_HEADER.size)
        if len(head) < RECORD_HEADER.size or not any(head):
            raise _CutOffError("zeros follow" if head else "the file ends there")
        opcode, length = RECORD_HEADER.unpack(head)
        if opcode not in known:
            raise ValueError("there is no record")
        if stream.tell() + length > size:
            raise _CutOffError("the file ends within a record")
        if length > CHUNK_LIMIT:
            raise ValueError(f"a record takes {length} bytes")
        body = stream.read(length)
        # Readers ignore the index of a chunk: a chunk must not be mistaken for one.
        if opcode == Opcode.MESSAGE_INDEX and int.from_bytes(body[2:6], "little") != length - 6:
            raise ValueError("there is no record")
        record = parse_record(opcode, memoryview(body))
        if isinstance(record, Chunk) and length != 40 + len(record.compression) + len(record.data):
            raise ValueError("the header of a chunk is wrong")
        following = cast(BufferedReader, stream).peek(1)[:1]
        # A message outside of chunks has no checksum: only the next record confirms its length.
        if opcode == Opcode.MESSAGE and following and following[0] not in _DATA:
            raise ValueError("the length of a message is wrong")
        yield stream.tell(), records_of(record) if isinstance(record, Chunk) else [record]


def _span(stream: BinaryIO) -> tuple[int, int] | None:
    """Return the earliest and latest log time [ns] by a file's index; None if that is damaged."""
    with contextlib.suppress(BrokenMcapError):
        told = find_index(stream)[0].statistics
        return None if told is None else (told.message_start_time, told.message_end_time)
    return None


def last_time(file: Path, start: int) -> tuple[int, bool]:
    """Return the latest log time [ns] in a file from an offset [B] on, and whether that is exact.

    It is exact if the index is whole. Else it is that of the chunks that are found, or 0.
    """
    latest = 0
    with open_regular(file) as stream:
        if span := _span(stream):
            return span[1], True
        with (
            contextlib.suppress(ValueError),
            mmap.mmap(stream.fileno(), 0, prot=mmap.PROT_READ) as data,
        ):
            for match in _CHUNK.finditer(data, start):
                length, first, last = struct.unpack_from("<QQQ", data, match.start() + 1)
                stored = int.from_bytes(match[0][-8:], "little")
                if length == 36 + len(match[1]) + stored and first <= last < TIME_LIMIT:
                    latest = max(latest, last)
    return latest, False
