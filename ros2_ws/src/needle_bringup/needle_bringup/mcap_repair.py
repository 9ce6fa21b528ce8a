"""Makes an MCAP file whole again where it is: what can be read stays, the index is written anew.

Nothing that can be read is moved or copied, so that it works on a full disk, too. Damaged regions
become records of a private kind, which every reader passes over: their bytes stay in the file.
"""

from __future__ import annotations

import dataclasses
import errno
import mmap
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO, Final

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import (
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from needle_bringup.mcap_chunk import CHUNK_HEADER, RECORD_HEADER, ChunkContent
from needle_bringup.mcap_scan import PRIVATE, Damage, McapScan, scan

# What a disk without room, a quota and a limit on file sizes answer.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DAMAGED: Final = PRIVATE | Opcode.CHUNK
_FOOTER_BODY: Final = struct.Struct("<BQQQ")


@dataclasses.dataclass(frozen=True)
class FileRecovery:
    """What was done to a file.

    Attributes
    ----------
    was_whole : bool
        Whether nothing had to be done.
    messages : int
        Messages that it holds now.
    salvaged : int
        How many of them come from a chunk that was cut.
    bytes_lost : int
        Bytes of data that could not be read.
    chunks_given_back : int
        Whole chunks given up to make room for the index, on a full disk.
    """

    was_whole: bool
    messages: int
    salvaged: int = 0
    bytes_lost: int = 0
    chunks_given_back: int = 0


def scan_file(path: Path, progress: Callable[[int], None] | None = None) -> McapScan:
    """Read a file's records (`mcap_scan.scan`).

    Raises
    ------
    NotMcapError
        If it is no MCAP file.
    OSError
        If it cannot be read.
    """
    with path.open("rb") as stream:
        if not stream.seek(0, os.SEEK_END):
            return scan(b"")
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return scan(data, progress)


def repair(path: Path, found: McapScan, *, profile: str = "ros2", library: str) -> FileRecovery:
    """Make a file whole.

    Parameters
    ----------
    path : Path
        The file.
    found : McapScan
        What `scan_file` found in it; brought up to date.
    profile, library : str
        For a file whose header is not whole.

    Raises
    ------
    OSError
        If the disk refuses the index even when all chunks are given up.
    """
    sound = not found.damage and not found.reindex
    if sound and found.finished and is_indexed(path, sum(found.counts.values())):
        return FileRecovery(True, sum(found.counts.values()))
    lost = sum(damage.end - damage.start for damage in found.damage)
    if not found.finished:
        lost += found.size - max(found.end, _salvage_end(found))
    salvaged = 0
    with path.open("r+b", buffering=0) as stream:
        if not found.end:
            _write_beginning(stream, profile, library, found)
        for damage in found.damage:
            _hide(stream, damage)
        for chunk, place in found.reindex:
            _write_index(stream, chunk, place)
        if found.half_chunk is not None:
            salvaged = _cut_half_chunk(stream, found)
        else:
            if found.lacks_last_index:
                found.end = found.chunks[-1].end
            stream.truncate(found.end)
        given_back = 0
        while not _append_summary(stream, found):
            give_back_chunk(stream, found)
            given_back += 1
        os.fsync(stream.fileno())
    return FileRecovery(False, sum(found.counts.values()), salvaged, lost, given_back)


def give_back_chunk(stream: IO[bytes], found: McapScan) -> None:
    """Cut the last chunk off, and what follows it, to make room.

    Raises
    ------
    OSError
        If there is none left.
    """
    if not found.chunks:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    start = found.chunks.pop().index.chunk_start_offset
    found.attachment_indexes = [a for a in found.attachment_indexes if a.offset < start]
    kept = [m for m in found.metadata_indexes if m.offset < start]
    found.metadata = found.metadata[: len(kept)]
    found.metadata_indexes = kept
    found.end = start
    stream.truncate(start)


def is_indexed(path: Path, messages: int) -> bool:
    """Return whether a file has an index of so many messages."""
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, ValueError, struct.error, OSError):
        return False
    return (
        summary is not None
        and summary.statistics is not None
        and summary.statistics.message_count == messages
    )


def _salvage_end(found: McapScan) -> int:
    return found.half_chunk.data_end if found.half_chunk is not None else 0


def _write_beginning(stream: IO[bytes], profile: str, library: str, found: McapScan) -> None:
    stream.truncate(0)
    stream.seek(0)
    builder = RecordBuilder()
    Header(profile, library).write(builder)
    found.end = stream.write(MCAP0_MAGIC + _bytes(builder))


def _hide(stream: IO[bytes], place: Damage) -> None:
    """Have readers pass over some bytes."""
    stream.seek(place.start)
    length = place.end - place.start - RECORD_HEADER.size
    stream.write(RECORD_HEADER.pack(_DAMAGED, length))


def _write_index(stream: IO[bytes], chunk: ChunkContent, place: Damage) -> None:
    """Write a chunk's message index again where it was."""
    room = place.end - place.start
    index = chunk.write_index(place.start)
    rest = room - len(index)
    if rest < 0 or 0 < rest < RECORD_HEADER.size:
        # Cannot be unless the file was made so: the chunk can be read without its index, too.
        chunk.index.message_index_offsets, chunk.index.message_index_length = {}, 0
        _hide(stream, place)
        return
    stream.seek(place.start)
    stream.write(index)
    if rest:
        _hide(stream, Damage(place.start + len(index), place.end))


def _cut_half_chunk(stream: IO[bytes], found: McapScan) -> int:
    """End the chunk that was being written behind its last whole message."""
    half = found.half_chunk
    assert half is not None
    index = half.content.index
    size = index.uncompressed_size
    # One write, so that an interruption leaves the old chunk or the new one.
    stream.seek(half.start)
    stream.write(
        RECORD_HEADER.pack(Opcode.CHUNK, index.chunk_length - RECORD_HEADER.size)
        + CHUNK_HEADER.pack(index.message_start_time, index.message_end_time, size, half.crc, 0)
        + struct.pack("<Q", size)
    )
    stream.truncate(half.data_end)
    found.chunks.append(half.content)
    found.end = half.data_end
    found.half_chunk = None
    return sum(half.content.counts.values())


def _append_summary(stream: IO[bytes], found: McapScan) -> bool:
    """Write what follows the data; False if there is no room for it."""
    lacks_index = bool(found.chunks) and found.end == found.chunks[-1].end
    data = found.chunks[-1].write_index(found.end) if lacks_index else b""
    records = RecordBuilder()
    DataEnd(0).write(records)
    tail = data + _bytes(records)
    tail += _summary(found, found.end + len(tail)) + MCAP0_MAGIC
    stream.seek(found.end)
    try:
        rest = memoryview(tail)
        while rest:
            rest = rest[stream.write(rest) :]
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        stream.truncate(found.end)
        return False
    return True


def _summary(found: McapScan, start: int) -> bytes:
    """Return summary, summary offsets and footer of a file whose summary begins at `start`."""
    counts = found.counts
    first, last = found.times
    statistics = Statistics(
        attachment_count=len(found.attachment_indexes),
        channel_count=len(found.channels),
        channel_message_counts=counts,
        chunk_count=len(found.chunks),
        message_count=sum(counts.values()),
        message_end_time=last,
        message_start_time=first or 0,
        metadata_count=len(found.metadata_indexes),
        schema_count=len(found.schemas),
    )
    groups: list[tuple[Opcode, list[McapRecord]]] = [
        (Opcode.SCHEMA, list(found.schemas.values())),
        (Opcode.CHANNEL, list(found.channels.values())),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, [chunk.index for chunk in found.chunks]),
        (Opcode.ATTACHMENT_INDEX, list(found.attachment_indexes)),
        (Opcode.METADATA_INDEX, list(found.metadata_indexes)),
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
    footer_size = _FOOTER_BODY.size - RECORD_HEADER.size + 4
    crc = zlib.crc32(
        _FOOTER_BODY.pack(Opcode.FOOTER, footer_size, start, offset_start), zlib.crc32(summary)
    )
    Footer(start, offset_start, crc).write(builder)
    return summary + _bytes(builder)


def _bytes(builder: RecordBuilder) -> bytes:
    """Return what was built, and begin anew."""
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data
