"""Ends an MCAP file where it is, after the disk that it is written to has become full.

There is no room for a copy then. What the disk took whole stays as it is; what it refused a part of
is cut off, and mcap's writer ends the file behind the rest.
"""

from __future__ import annotations

import errno
import os
import struct
from collections import Counter
from pathlib import Path
from typing import Any, Final

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex, Statistics
from mcap.writer import Writer

# What a disk without room, a quota and a limit on file sizes answer.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Of a message index: opcode, length, channel; then the size of its entries, each so large.
_ENTRIES_AT: Final = 11
_ENTRY: Final = 16


class McapEnding:
    """A file of chunks without its end.

    Parameters
    ----------
    writer : Writer
        What wrote it, as far as the disk took it; the pinned version's own variables tell where its
        records are.
    path : Path
        The file, closed.

    Raises
    ------
    OSError
        If it cannot be read.
    """

    def __init__(self, writer: Writer, path: Path) -> None:
        self._writer = writer
        self._path = path
        self._keep(path.stat().st_size)

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        channels = self._of("channels")
        counts = self._of("statistics").channel_message_counts
        return {channels[number].topic: count for number, count in counts.items()}

    @property
    def times(self) -> tuple[int | None, int]:
        """Log times of the earliest and the latest message [ns]; None, 0 where there is none."""
        chunks: list[ChunkIndex] = self._of("chunk_indices")
        first = min((index.message_start_time for index in chunks), default=None)
        return first, max((index.message_end_time for index in chunks), default=0)

    def write(self) -> None:
        """Write the index; the last chunks make room for it where there is none.

        Raises
        ------
        OSError
            If the disk refuses it even without any chunk.
        """
        while True:
            end = self._prepare()
            try:
                with self._path.open("r+b") as stream:
                    stream.truncate(end)
                    stream.seek(end)
                    self._set("stream", stream)
                    self._writer.finish()  # type: ignore[no-untyped-call]
                    stream.flush()
                    os.fsync(stream.fileno())
            except OSError as error:
                if error.errno not in NO_ROOM:
                    raise
                os.truncate(self._path, end)
                self.give_back()
            else:
                return

    def give_back(self) -> None:
        """Give up the last chunk, and what follows it, to make room.

        Raises
        ------
        OSError
            If there is none left.
        """
        chunks: list[ChunkIndex] = self._of("chunk_indices")
        if not chunks:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._keep(chunks[-1].chunk_start_offset)

    def _keep(self, size: int) -> None:
        """Give up what does not end within so many bytes."""
        for name in ("chunk_indices", "metadata_indexes", "attachment_indexes"):
            self._set(name, [index for index in self._of(name) if _end_of(index) <= size])

    def _prepare(self) -> int:
        """Have the writer end a file of what is kept, and nothing else; return where that ends."""
        chunks = self._of("chunk_indices")
        metadata, attachments = self._of("metadata_indexes"), self._of("attachment_indexes")
        # The first record behind the header is metadata.
        if not metadata:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        counts: Counter[int] = Counter()
        with self._path.open("rb") as stream:
            for index in chunks:
                for channel, start in index.message_index_offsets.items():
                    size = struct.unpack("<I", os.pread(stream.fileno(), 4, start + _ENTRIES_AT))
                    counts[channel] += size[0] // _ENTRY
        first, last = self.times
        self._set(
            "statistics",
            Statistics(
                attachment_count=len(attachments),
                channel_count=len(self._of("channels")),
                channel_message_counts=dict(counts),
                chunk_count=len(chunks),
                message_count=counts.total(),
                message_end_time=last,
                message_start_time=first or 0,
                metadata_count=len(metadata),
                schema_count=len(self._of("schemas")),
            ),
        )
        self._of("chunk_builder").reset()
        self._set("record_builder", RecordBuilder())
        self._set("summary_offsets", [])
        return max(_end_of(index) for index in (*chunks, *metadata, *attachments))

    def _of(self, name: str) -> Any:
        return vars(self._writer)[f"_Writer__{name}"]

    def _set(self, name: str, value: Any) -> None:
        vars(self._writer)[f"_Writer__{name}"] = value


def _end_of(index: Any) -> int:
    """Return where that ends in the file which an index tells of."""
    if isinstance(index, ChunkIndex):
        return int(index.chunk_start_offset + index.chunk_length + index.message_index_length)
    return int(index.offset + index.length)
