"""Reads an MCAP file record by record, without its index: what is whole in it, and what is not.

The format: https://mcap.dev/spec. A damaged region is passed over up to the next chunk whose
checksum is right; what a crash cut off is told apart from what was complete.
"""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections.abc import Callable, Iterable
from io import BytesIO
from typing import Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
)
from mcap.writer import MCAP0_MAGIC

from needle_bringup.mcap_chunk import (
    RECORD_HEADER,
    SIZE,
    UNREADABLE,
    ChunkContent,
    Definition,
    HalfChunk,
    index_record,
    read_chunk,
    read_definition,
    read_half_chunk,
)

_MESSAGE: Final = struct.Struct("<HIQQ")
# Opcodes from here on are an application's own; every reader passes over them.
PRIVATE: Final = 0x80
_DATA_OPCODES: Final = frozenset(
    (
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    )
)
_REPORT_EVERY: Final = 16 * 2**20


class NotMcapError(Exception):
    """The file is not MCAP at all."""


@dataclasses.dataclass(frozen=True)
class Damage:
    """Bytes [start, end) of the file that hold nothing that can be read."""

    start: int
    end: int


@dataclasses.dataclass
class McapScan:
    """What a file holds.

    Attributes
    ----------
    size : int
        Bytes of the file.
    end : int
        Where its data ends: behind the last record that is whole or passed over.
    finished : bool
        Whether the data's end mark is there: the file was closed in order.
    schemas, channels : dict
        By number.
    chunks : list of ChunkContent
        In order.
    loose : dict of int to int
        Messages outside of chunks, for each channel.
    metadata : list of Metadata
        In order.
    metadata_indexes, attachment_indexes : list
        As the summary has them.
    damage : list of Damage
        What was passed over.
    reindex : list of (ChunkContent, Damage)
        Chunks whose message index is not whole, and where it was.
    lacks_last_index : bool
        Whether the data ends in a chunk without its whole message index.
    half_chunk : HalfChunk or None
        The chunk that the file's end cuts, if something in it is whole.
    loose_first, loose_last : int or None, int
        Log times of the earliest and latest message outside of chunks [ns].
    """

    size: int
    end: int
    finished: bool = False
    schemas: dict[int, Schema] = dataclasses.field(default_factory=dict)
    channels: dict[int, Channel] = dataclasses.field(default_factory=dict)
    chunks: list[ChunkContent] = dataclasses.field(default_factory=list)
    loose: dict[int, int] = dataclasses.field(default_factory=dict)
    metadata: list[Metadata] = dataclasses.field(default_factory=list)
    metadata_indexes: list[MetadataIndex] = dataclasses.field(default_factory=list)
    attachment_indexes: list[AttachmentIndex] = dataclasses.field(default_factory=list)
    damage: list[Damage] = dataclasses.field(default_factory=list)
    reindex: list[tuple[ChunkContent, Damage]] = dataclasses.field(default_factory=list)
    lacks_last_index: bool = False
    half_chunk: HalfChunk | None = None
    loose_first: int | None = None
    loose_last: int = 0

    @property
    def counts(self) -> dict[int, int]:
        """Messages for each channel."""
        total = dict(self.loose)
        for chunk in self.chunks:
            for channel, count in chunk.counts.items():
                total[channel] = total.get(channel, 0) + count
        return total

    @property
    def times(self) -> tuple[int | None, int]:
        """Log times of the earliest and the latest message [ns]; None, 0 where there is none."""
        firsts = [c.index.message_start_time for c in self.chunks]
        lasts = [c.index.message_end_time for c in self.chunks]
        if self.loose_first is not None:
            firsts.append(self.loose_first)
            lasts.append(self.loose_last)
        return min(firsts, default=None), max(lasts, default=0)


def scan(data: Any, progress: Callable[[int], None] | None = None) -> McapScan:
    """Read a file's records.

    Parameters
    ----------
    data : mmap or bytes
        The file.
    progress : callable, optional
        Called with the offset reached, now and then.

    Raises
    ------
    NotMcapError
        If the file begins as no MCAP file of ROS 2 does.
    """
    return _Scanner(data, progress).run()


class _Scanner:
    def __init__(self, data: Any, progress: Callable[[int], None] | None) -> None:
        self._data = data
        self._size = len(data)
        self._progress = progress
        self._reported = 0
        self._is_index_open = False
        self.found = McapScan(self._size, 0)

    def run(self) -> McapScan:
        data, found = self._data, self.found
        beginning = bytes(data[: len(MCAP0_MAGIC)])
        if not MCAP0_MAGIC.startswith(beginning):
            raise NotMcapError("it does not begin as an MCAP file")
        position = len(MCAP0_MAGIC)
        length = self._length(position)
        if length is None or position + length > self._size:
            return found  # not even its header is whole
        if data[position] != Opcode.HEADER:
            raise NotMcapError("it has no MCAP header")
        header = Header.read(self._body(position))
        if header.profile not in ("ros2", ""):
            raise NotMcapError(f"its profile is {header.profile!r}, not 'ros2'")
        position += length
        found.end = position
        while position < self._size:
            following = self._take(position)
            if following is None:
                break
            found.end = position = following
            self._report(position)
        if found.finished:
            self._read_definitions_of_summary()
        found.lacks_last_index = self._is_index_open and not found.chunks[-1].is_indexed
        self._name_unknown_channels()
        return found

    def _take(self, position: int) -> int | None:
        """Take the record at a position; return where the next begins, None at the data's end."""
        opcode, length = self._data[position], self._length(position)
        known = opcode in _DATA_OPCODES or opcode >= PRIVATE
        if length is None or not known or position + length > self._size:
            found = self._next_chunk(position + 1)
            if found is None:
                if opcode == Opcode.CHUNK and length is not None:
                    self._take_half_chunk(position, length)
                return None
            self._pass_over(position, found)
            return found
        if opcode == Opcode.DATA_END:
            self.found.finished = True
            return None
        try:
            self._read(opcode, position, length)
        # Struct errors, texts that are not UTF-8, lengths that point outside, bad checksums.
        except UNREADABLE:
            # A power cut leaves zeros where the file was made longer and nothing was written.
            if opcode == Opcode.CHUNK and not any(self._data[position + length :]):
                self._take_half_chunk(position, length)
                if self.found.half_chunk is not None:
                    return None
            self._pass_over(position, position + length)
        return position + length

    def _read(self, opcode: int, position: int, length: int) -> None:
        found = self.found
        if opcode != Opcode.MESSAGE_INDEX:
            self._close_index(position)
        if opcode == Opcode.CHUNK:
            content, definitions = read_chunk(self._data, position, length)
            self._define(definitions)
            found.chunks.append(content)
            self._is_index_open = True
        elif opcode == Opcode.MESSAGE_INDEX:
            self._take_message_index(position, length)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define([read_definition(self._data[position : position + length], 0)])
        elif opcode == Opcode.MESSAGE:
            channel, _, time, _ = _MESSAGE.unpack_from(self._data, position + RECORD_HEADER.size)
            found.loose[channel] = found.loose.get(channel, 0) + 1
            first = found.loose_first
            found.loose_first = time if first is None else min(first, time)
            found.loose_last = max(found.loose_last, time)
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(self._body(position))
            found.metadata.append(metadata)
            found.metadata_indexes.append(MetadataIndex(position, length, metadata.name))
        elif opcode == Opcode.ATTACHMENT:
            found.attachment_indexes.append(self._attachment(position, length))

    def _take_half_chunk(self, position: int, length: int) -> None:
        half, definitions = read_half_chunk(self._data, position, length)
        self.found.half_chunk = half
        self._define(definitions)

    def _take_message_index(self, position: int, length: int) -> None:
        damaged = self.found.damage
        if damaged and damaged[-1].end == position:
            # The index of a chunk that could not be read goes with it.
            self._pass_over(position, position + length)
        elif self._is_index_open:
            (channel,) = struct.unpack_from("<H", self._data, position + RECORD_HEADER.size)
            chunk = self.found.chunks[-1]
            record = self._data[position : position + length]
            if record != index_record(channel, chunk.entries.get(channel, [])):
                raise ValueError("the message index does not fit the chunk")
            chunk.index.message_index_offsets[channel] = position
            chunk.index.message_index_length += length

    def _close_index(self, end: int) -> None:
        """Take note if the last chunk's message index, which ends here, is not whole."""
        if not self._is_index_open:
            return
        self._is_index_open = False
        found = self.found
        chunk = found.chunks[-1]
        start = chunk.end
        if chunk.is_indexed or end == start:
            chunk.entries = {}
            return
        found.reindex.append((chunk, Damage(start, end)))
        found.damage = [damage for damage in found.damage if damage.end <= start]

    def _define(self, definitions: Iterable[Definition]) -> None:
        for record in definitions:
            if isinstance(record, Schema):
                self.found.schemas[record.id] = record
            else:
                self.found.channels[record.id] = record

    def _attachment(self, position: int, length: int) -> AttachmentIndex:
        start, end = position + RECORD_HEADER.size, position + length
        (crc,) = struct.unpack_from("<I", self._data, end - 4)
        if crc and zlib.crc32(self._data[start : end - 4]) != crc:
            raise ValueError("the attachment's checksum is wrong")
        body = self._body(position)
        log_time, create_time = body.read8(), body.read8()
        name, media_type = body.read_prefixed_string(), body.read_prefixed_string()
        return AttachmentIndex(
            offset=position,
            length=length,
            log_time=log_time,
            create_time=create_time,
            data_size=body.read8(),
            name=name,
            media_type=media_type,
        )

    def _next_chunk(self, position: int) -> int | None:
        """Return where the next whole chunk begins."""
        mark = bytes([Opcode.CHUNK])
        while (position := self._data.find(mark, position)) >= 0:
            length = self._length(position)
            if length is not None and position + length <= self._size:
                try:
                    read_chunk(self._data, position, length)
                except UNREADABLE:
                    pass
                else:
                    return position
            position += 1
            self._report(position)
        return None

    def _pass_over(self, start: int, end: int) -> None:
        damage = self.found.damage
        if damage and damage[-1].end == start:
            damage[-1] = Damage(damage[-1].start, end)
        else:
            damage.append(Damage(start, end))

    def _read_definitions_of_summary(self) -> None:
        """Take topics' definitions from the summary, too: damage may have swallowed them."""
        position = self.found.end
        while (length := self._length(position)) is not None and position + length <= self._size:
            opcode = self._data[position]
            if opcode == Opcode.FOOTER:
                return
            try:
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    record = read_definition(self._data[position : position + length], 0)
                    known = self.found.schemas if opcode == Opcode.SCHEMA else self.found.channels
                    if record.id not in known:
                        self._define([record])
            except UNREADABLE:
                return
            position += length

    def _name_unknown_channels(self) -> None:
        """Keep messages readable, as bytes, whose topic's definition was damaged."""
        channels, schemas = self.found.channels, self.found.schemas
        counts = dict(self.found.counts)
        if self.found.half_chunk is not None:
            counts.update(self.found.half_chunk.content.counts)
        for number in counts:
            channel = channels.get(number)
            if channel is None:
                channels[number] = Channel(number, f"/unknown/channel_{number}", "cdr", {}, 0)
            elif channel.schema_id not in schemas:
                channels[number] = dataclasses.replace(channel, schema_id=0)

    def _length(self, position: int) -> int | None:
        """Return a record's length with its header; None where the file ends within the header."""
        if position + RECORD_HEADER.size > self._size:
            return None
        return RECORD_HEADER.size + int(SIZE.unpack_from(self._data, position + 1)[0])

    def _body(self, position: int) -> ReadDataStream:
        length = self._length(position) or 0
        return ReadDataStream(
            BytesIO(self._data[position + RECORD_HEADER.size : position + length])
        )

    def _report(self, position: int) -> None:
        if self._progress is not None and position - self._reported >= _REPORT_EVERY:
            self._reported = position
            self._progress(position)
