"""Ends an MCAP file where it is, after the disk that it is written to has become full.

There is no room for a copy then. What the recorder's writer left whole stays as it is; what the
disk refused a part of is cut off, and the index is written behind the rest.
"""

from __future__ import annotations

import contextlib
import errno
import os
import struct
import zlib
from collections import Counter
from pathlib import Path
from typing import IO, Final

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from needle_common.files.mcap_file import RECORD_HEADER, UNREADABLE, records_of

# What a disk without room, a quota and a limit on file sizes answer.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FOOTER_BODY: Final = struct.Struct("<BQQQ")


class McapEnding:
    """A file of chunks without its end.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    OSError
        If it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunks: list[tuple[ChunkIndex, Counter[int]]] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._end = 0
        with path.open("rb") as stream, contextlib.suppress(*UNREADABLE):
            self._read(stream)
        self._chunks = [c for c in self._chunks if c[0].chunk_start_offset < self._end]

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        total: Counter[str] = Counter()
        for _, counts in self._chunks:
            for number, count in counts.items():
                total[self._channels[number].topic] += count
        return dict(total)

    @property
    def times(self) -> tuple[int | None, int]:
        """Log times of the earliest and the latest message [ns]; None, 0 where there is none."""
        indexes = [index for index, _ in self._chunks]
        first = min((index.message_start_time for index in indexes), default=None)
        return first, max((index.message_end_time for index in indexes), default=0)

    def write(self) -> None:
        """Write the index; the last chunks make room for it where there is none.

        Raises
        ------
        OSError
            If the disk refuses it even without any chunk.
        """
        if not self._end:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        while True:
            builder = RecordBuilder()
            DataEnd(0).write(builder)
            tail = _bytes(builder)
            tail += self._summary(self._end + len(tail)) + MCAP0_MAGIC
            with self._path.open("r+b", buffering=0) as stream:
                stream.truncate(self._end)
                stream.seek(self._end)
                try:
                    rest = memoryview(tail)
                    while rest:
                        rest = rest[stream.write(rest) :]
                    os.fsync(stream.fileno())
                except OSError as error:
                    if error.errno not in NO_ROOM:
                        raise
                    stream.truncate(self._end)
                else:
                    return
            self.give_back()

    def give_back(self) -> None:
        """Give up the last chunk, and what follows it, to make room.

        Raises
        ------
        OSError
            If there is none left.
        """
        if not self._chunks:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._end = self._chunks.pop()[0].chunk_start_offset
        self._attachments = [a for a in self._attachments if a.offset < self._end]
        self._metadata = [m for m in self._metadata if m.offset < self._end]

    def _read(self, stream: IO[bytes]) -> None:
        position = stream.seek(len(MCAP0_MAGIC))
        for record in StreamReader(stream, skip_magic=True, emit_chunks=True).records:
            end = stream.tell()
            (length,) = struct.unpack("<Q", os.pread(stream.fileno(), 8, position + 1))
            if end != position + RECORD_HEADER.size + length or isinstance(record, DataEnd):
                return
            self._take(record, position, end)
            if not self._chunks or self._is_indexed():
                self._end = end
            position = end

    def _is_indexed(self) -> bool:
        index, counts = self._chunks[-1]
        return set(index.message_index_offsets) == set(counts)

    def _take(self, record: McapRecord, start: int, end: int) -> None:
        size = end - start
        if isinstance(record, Chunk):
            counts: Counter[int] = Counter()
            for one in records_of(record):
                if isinstance(one, Message):
                    counts[one.channel_id] += 1
                elif isinstance(one, Schema):
                    self._schemas[one.id] = one
                elif isinstance(one, Channel):
                    self._channels[one.id] = one
            index = ChunkIndex(
                chunk_length=size,
                chunk_start_offset=start,
                compression=record.compression,
                compressed_size=len(record.data),
                message_end_time=record.message_end_time,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=record.message_start_time,
                uncompressed_size=record.uncompressed_size,
            )
            self._chunks.append((index, counts))
        elif isinstance(record, MessageIndex):
            index = self._chunks[-1][0]
            index.message_index_offsets[record.channel_id] = start
            index.message_index_length += size
        elif isinstance(record, Metadata):
            self._metadata.append(MetadataIndex(start, size, record.name))
        elif isinstance(record, Attachment):
            self._attachments.append(
                AttachmentIndex(
                    offset=start,
                    length=size,
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
            )

    def _summary(self, start: int) -> bytes:
        """Return summary, summary offsets and footer of a file whose summary begins at `start`."""
        chunks = self._chunks
        counts = sum((c for _, c in chunks), Counter[int]())
        first, last = self.times
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=dict(counts),
            chunk_count=len(chunks),
            message_count=counts.total(),
            message_end_time=last,
            message_start_time=first or 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, [index for index, _ in chunks]),
            (Opcode.ATTACHMENT_INDEX, list(self._attachments)),
            (Opcode.METADATA_INDEX, list(self._metadata)),
        ]
        builder, offsets = RecordBuilder(), []
        for opcode, records in groups:
            begin = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(opcode, start + begin, builder.count - begin))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = _bytes(builder)
        body = _FOOTER_BODY.pack(
            Opcode.FOOTER, _FOOTER_BODY.size - RECORD_HEADER.size + 4, start, offset_start
        )
        Footer(start, offset_start, zlib.crc32(body, zlib.crc32(summary))).write(builder)
        return summary + _bytes(builder)


def _bytes(builder: RecordBuilder) -> bytes:
    """Return what was built, and begin anew."""
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
