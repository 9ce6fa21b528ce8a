"""Copies the intact prefix of an MCAP file."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import IO, Any, Final

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from needle_bags.format.bag_writer import CHUNK_SIZE, LIBRARY
from needle_core.files.file_access import open_regular

# Errors of mcap's reader on damaged data.
_DAMAGE: Final = (
    *(McapError, ValueError, LookupError, struct.error, OverflowError, RuntimeError),
    zstandard.ZstdError,
)


class PrefixCopy:
    """Copy of all records before the first damaged one; its writer is not finished yet.

    Parameters
    ----------
    source : Path
        The damaged file.
    target : file
        Destination.

    Raises
    ------
    OSError
        If the disk refuses it.

    Attributes
    ----------
    writer : Writer
        Writer of the copy.
    end : int
        Position of the damage [B]; 0 if there is no intact record.
    reason : str
        The kind of damage; empty if the data end properly.
    messages, last : int
        Messages in the copy, and their latest log time [ns].
    """

    def __init__(self, source: Path, target: IO[bytes]) -> None:
        self.writer = Writer(target, CHUNK_SIZE)
        self.end = self.messages = self.last = 0
        self.reason = ""
        self._schemas = {0: 0}
        self._channels: dict[int, int] = {}
        with open_regular(source) as stream:
            try:
                # The reader returns the records of a chunk after checking its checksum.
                for record in StreamReader(stream, validate_crcs=True).records:
                    self._copy(record)
                    self.end = stream.tell()
            except EndOfFile:
                self.reason = "the file ends inside a record"
            except _DAMAGE as error:
                self.reason = f"a record is damaged: {type(error).__name__}"

    def _copy(self, record: Any) -> None:
        match record:
            case Header():
                self.writer.start(record.profile, LIBRARY)
            case Schema() if record.id not in self._schemas:
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
                self.writer.add_message(
                    self._channels[record.channel_id],
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
                self.messages += 1
                self.last = max(self.last, record.log_time)
            case Metadata():
                self.writer.add_metadata(record.name, record.metadata)
            case Attachment():
                self.writer.add_attachment(**vars(record))
