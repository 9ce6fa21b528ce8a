"""Reads an MCAP file record by record, whatever state it is in, and finds all that is whole.

The format: https://mcap.dev/spec. A chunk whose checksum is right is taken as it is. Where nothing
has a checksum, a record is taken if its fields agree with each other and a message fits its type.
Behind what is damaged, the next record that passes is searched for byte by byte.
"""

from __future__ import annotations

import dataclasses
import re
import struct
from collections import Counter
from collections.abc import Callable, Collection
from io import BytesIO
from typing import Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Header, Message, MessageIndex, Schema
from mcap.writer import MCAP0_MAGIC

from needle_bags.recovery.mcap_chunk import CHUNK_HEADER, SIZE, chunk_end, find_chunk, index_of
from needle_bags.recovery.mcap_records import (
    MESSAGE,
    RECORDS,
    Loose,
    McapScan,
    NotMcapError,
    messages_of,
    read_message,
    read_record,
)
from needle_bags.recovery.message_fit import MessageFit, mended_schema
from needle_common.files.bag_data import is_packed
from needle_common.files.mcap_file import (
    RECORD_HEADER,
    SUMMARY_LIMIT,
    TIME_LIMIT,
    UNREADABLE,
    BrokenMcapError,
    read_index,
)

# Opcodes from here on are an application's own; every reader passes over them.
PRIVATE: Final = 0x80
_CANDIDATE: Final = re.compile(rb"[\x03-\x07\x09\x0c\x0f][\x00-\xff]{4}\x00{4}")
_INDEX: Final = frozenset(
    (
        Opcode.FOOTER,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.STATISTICS,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    )
)
_KNOWN: Final = frozenset((*RECORDS, *_INDEX, *(5, 6, 7, 9, 15)))
_REPORT_EVERY: Final = 16 * 2**20
_BLOCK: Final = 2**20
# Bytes behind a message that its type does not tell: what a wrong length may be wrong by.
_PADDING: Final = (0, -1, -2, -3, 1, 2, 3)


def scan(data: Any, progress: Callable[[int], object]) -> McapScan:
    """Read a file's records.

    Parameters
    ----------
    data : mmap or bytes
        The file.
    progress : callable
        Called with the offset reached, now and then.

    Raises
    ------
    NotMcapError
        If there is nothing of an MCAP file of ROS 2 in it.
    """
    first = _Scanner(data, progress)
    found = first.run()
    # Where most messages do not fit, it is their definition that is damaged.
    distrusted = {n for n, count in first.refused.items() if count > found.counts[n]}
    return _Scanner(data, progress, distrusted).run() if distrusted else found


class _Scanner:
    def __init__(
        self,
        data: Any,
        progress: Callable[[int], object],
        distrusted: Collection[int] = (),
    ) -> None:
        self._data = data
        self._end = self._zeros = len(data)
        self._progress = progress
        self._reported = 0
        self._has_header = False
        self.found = McapScan(self._end, distrusted=distrusted)
        self._fit = MessageFit(self.found.schemas, self.found.channels, distrusted)
        self.refused: Counter[int] = Counter()
        self._chunks: dict[int, ChunkIndex] = {}
        self._expected: dict[int, list[tuple[int, int]]] = {}

    def run(self) -> McapScan:
        found = self.found
        try:
            begin = max(0, self._end - SUMMARY_LIMIT)
            found.index = read_index(bytes(self._data[begin:]), self._end)
        except BrokenMcapError:
            # A power cut leaves zeros where the file was made longer and nothing was written.
            self._zeros = _end_of_data(self._data)
        else:
            self._end, records = found.index.start, found.index.records
            self._chunks = {chunk.chunk_start_offset: chunk for chunk in records.chunk_indexes}
            if found.index.is_checked:
                found.schemas.update(records.schemas)
                found.channels.update(records.channels)
        position = self._begin()
        while position < self._end and not found.finished:
            following = self._take(position)
            if following is None:
                following = self._next(position + 1)
                self._pass_over(position, following)
            position = following
            self._report(position)
        self._close_index()
        self._read_definitions(position)
        self._settle_definitions()
        if not found.parts and not self._has_header and found.size > len(MCAP0_MAGIC):
            raise NotMcapError("it does not begin as an MCAP file, and holds nothing of one")
        return found

    def _begin(self) -> int:
        """Return where the first record behind the header is."""
        data = self._data
        size = len(MCAP0_MAGIC)
        end = self._end_of(size)
        try:
            if bytes(data[:size]) == MCAP0_MAGIC and self._end > size and data[size] == 1:
                self._has_header = end is None
                header = Header.read(ReadDataStream(BytesIO(bytes(data[size + 9 : end]))))
                self._has_header = header.profile in ("ros2", "")
                if self._has_header and end is not None and self._is_plausible(end):
                    return end
        except UNREADABLE:
            pass
        start = self._next(size)
        self._pass_over(0, start)
        return start

    def _take(self, position: int) -> int | None:
        """Take the record at a position; return where the next begins, None if there is none."""
        try:
            return self._read(position)
        # Struct errors, texts that are not UTF-8, lengths that point outside, bad checksums.
        except UNREADABLE:
            return None

    def _read(self, position: int) -> int | None:
        data, found = self._data, self.found
        opcode = data[position]
        if opcode != Opcode.MESSAGE_INDEX:
            self._close_index()
        if opcode == Opcode.CHUNK or position in self._chunks:
            return self._read_chunk(position)
        if opcode == Opcode.MESSAGE:
            return self._read_loose(position)
        end = self._end_of(position)
        if end is None:
            return None
        if opcode == Opcode.MESSAGE_INDEX:
            self._read_index(position, end)
        elif opcode == Opcode.DATA_END:
            if end - position != RECORD_HEADER.size + 4:
                return None
            found.finished = True
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(read_record(data, position, end))
        elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT):
            read_record(data, position, end)
            found.parts.append(Loose(position, end))
        elif (opcode < PRIVATE and opcode not in _INDEX) or not self._is_plausible(end):
            return None
        return end

    def _read_chunk(self, position: int) -> int | None:
        index = self._chunks.get(position)
        chunk = find_chunk(self._data, position, self._end, index)
        if chunk is not None and (chunk.is_vouched or chunk.compression):
            records = chunk.records(self._data)
            for record in records:
                if isinstance(record, Schema | Channel):
                    self._define(record)
            for message in messages_of(self._data, chunk, self._fit):
                self._count(message)
            self.found.parts.append(chunk)
            self.found.mended += chunk.is_mended
            if index is None or index.message_index_offsets:
                self._expected = index_of(records)
            return chunk.end
        crc, name_length = struct.unpack_from("<II", self._data, position + 33)
        end = chunk_end(self._data, position, index)
        is_whole = end is not None and end <= min(self._end, self._zeros)
        if chunk is None and (crc or name_length) and end is not None and is_whole:
            # Something in it is not what was written, and nothing tells what.
            self._pass_over(position, end)
            return end
        # Not compressed, and no checksum or no end: what is in it is looked at by itself.
        inside = position + RECORD_HEADER.size + CHUNK_HEADER.size + SIZE.size
        return None if name_length or inside > self._end else inside

    def _read_loose(self, position: int) -> int | None:
        told = self._end_of(position, strict=False)
        if told is None or told - position < RECORD_HEADER.size + MESSAGE.size:
            return None
        channel, _, log_time, publish_time = MESSAGE.unpack_from(
            self._data, position + RECORD_HEADER.size
        )
        is_known = self._fit.knows(channel)
        is_closed = self.found.index is not None and self.found.index.is_checked
        if (
            not self._is_time(log_time)
            or publish_time >= TIME_LIMIT
            or (self._zeros < told < self._end)  # its own end may be among the zeros
            or (is_closed and not is_known and channel not in self.found.channels)
        ):
            return None
        for further in _PADDING:
            end = told + further
            if position + RECORD_HEADER.size + MESSAGE.size <= end <= self._end and (
                self._is_plausible(end) and (not is_known or self._fits(position, end))
            ):
                self.found.mended += end != told
                return self._keep(position, end)
        if is_known and told <= self._end and self._fits(position, told):
            return self._keep(position, told)
        self.refused[channel] += 1
        return None

    def _fits(self, start: int, end: int) -> bool:
        message = read_message(self._data, start, end)
        return self._fit.fits(message.channel_id, message.data)

    def _keep(self, start: int, end: int) -> int:
        self.found.parts.append(Loose(start, end))
        self._count(read_message(self._data, start, end))
        return end

    def _read_index(self, position: int, end: int) -> None:
        """Compare a message index with its chunk's messages."""
        stream = ReadDataStream(BytesIO(bytes(self._data[position + 9 : end])))
        index = MessageIndex.read(stream)
        if stream.count != end - position - 9:
            raise ValueError("the message index is longer than what is in it")
        if not self._expected:
            return  # of a chunk that was looked at message by message, or is lost
        if sorted(self._expected.pop(index.channel_id, [])) != sorted(index.records):
            self.found.mended += 1

    def _close_index(self) -> None:
        """Take note of messages in the last chunk that no index tells of."""
        self.found.mended += bool(self._expected)
        self._expected = {}

    def _count(self, message: Message) -> None:
        found = self.found
        found.counts[message.channel_id] += 1
        found.packed += is_packed(message.data)
        found.gaps.take(message.channel_id, message.sequence, len(found.damage))

    def _define(self, record: Schema | Channel) -> None:
        known: dict[int, Any] = (
            self.found.schemas if isinstance(record, Schema) else self.found.channels
        )
        if record.id in known and known[record.id] != record:
            self.found.mended += 1
        known.setdefault(record.id, record)
        self._fit.forget()

    def _next(self, position: int) -> int:
        """Return where the next whole record begins; the data's end if there is none."""
        while match := _CANDIDATE.search(self._data, position, self._end):
            position = match.start()
            if self._is_record(position):
                return position
            position += 1
            self._report(position)
        return self._end

    def _is_record(self, position: int) -> bool:
        """Return whether a record begins here for certain."""
        end = self._end_of(position)
        try:
            return end is not None and self._is_certain(position, end)
        except UNREADABLE:
            return False

    def _is_certain(self, position: int, end: int) -> bool:
        data, opcode = self._data, self._data[position]
        if opcode == Opcode.CHUNK:
            return find_chunk(data, position, self._end, self._chunks.get(position)) is not None
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, publish_time = MESSAGE.unpack_from(data, position + 9)
            return (
                end - position >= RECORD_HEADER.size + MESSAGE.size
                and (self._fit.knows(channel) or channel in self.found.channels)
                and self._is_time(log_time)
                and publish_time < TIME_LIMIT
                and self._fits(position, end)
                and (self._fit.knows(channel) or self._is_plausible(end))
            )
        if opcode == Opcode.MESSAGE_INDEX:
            channel, size = struct.unpack_from("<HI", data, position + 9)
            is_sized = 0 < size == end - position - 15 and not size % 16
            return is_sized and channel in self.found.channels
        if opcode == Opcode.DATA_END:
            return end - position == 13 and end < len(data) and data[end] in (*RECORDS, *_INDEX)
        read_record(data, position, end)
        return self._is_plausible(end)

    def _is_plausible(self, position: int) -> bool:
        """Return whether a record may begin here, or the data end."""
        if position == self._end:
            return True
        end = self._end_of(position, strict=False)
        opcode = self._data[position] if position < self._end else 0
        return end is not None and (opcode in _KNOWN or opcode >= PRIVATE)

    def _is_time(self, time: int) -> bool:
        index = self.found.index
        if index is not None and index.is_checked and index.records.statistics is not None:
            told = index.records.statistics
            return bool(told.message_start_time <= time <= told.message_end_time)
        return time < TIME_LIMIT

    def _end_of(self, position: int, *, strict: bool = True) -> int | None:
        """Return where a record ends; None if that is not in the file."""
        if position + RECORD_HEADER.size > self._end:
            return None
        length = RECORD_HEADER.unpack_from(self._data, position)[1]
        end = int(position + RECORD_HEADER.size + length)
        limit = self._end if strict else self._end + (1 << 32)
        return end if end <= limit else None

    def _pass_over(self, start: int, end: int) -> None:
        damage = self.found.damage
        if damage and damage[-1].end == start:
            damage[-1] = Loose(damage[-1].start, end)
        elif end > start:
            damage.append(Loose(start, end))

    def _read_definitions(self, position: int) -> None:
        """Take definitions from an index that is damaged, too: those of the data may be lost."""
        while (end := self._end_of(position)) is not None:
            if self._data[position] in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    record = read_record(self._data, position, end)
                except UNREADABLE:
                    return
                known = self.found.schemas if isinstance(record, Schema) else self.found.channels
                if record.id not in known:
                    self._define(record)
            position = end

    def _settle_definitions(self) -> None:
        """Keep messages readable, as bytes, whose topic's definition was damaged."""
        found = self.found
        for number in found.counts:
            if number not in found.channels:
                found.channels[number] = Channel(number, f"/unknown/channel_{number}", "cdr", {}, 0)
        for number, channel in list(found.channels.items()):
            schema = found.schemas.get(channel.schema_id)
            if schema is None:
                found.channels[number] = dataclasses.replace(channel, schema_id=0)
                found.mended += bool(channel.schema_id)
                continue
            found.schemas[schema.id] = mended_schema(schema, channel)
            found.mended += found.schemas[schema.id] != schema

    def _report(self, position: int) -> None:
        if position - self._reported >= _REPORT_EVERY:
            self._reported = position
            self._progress(position)


def _end_of_data(data: Any) -> int:
    """Return where the zeros begin that the file ends in."""
    position = len(data)
    while position:
        block = bytes(data[max(0, position - _BLOCK) : position])
        kept = block.rstrip(b"\0")
        position -= len(block) - len(kept)
        if kept:
            break
    return position
