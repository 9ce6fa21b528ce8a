"""Writes an MCAP file anew from what is whole in a damaged one."""

from __future__ import annotations

import os
from collections import Counter
from typing import IO, Any, Final

from mcap.opcode import Opcode
from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer

from needle_bags.format.bag_metadata import METADATA_RECORD, DataFile
from needle_bags.format.bag_writer import CHUNK_SIZE, LIBRARY
from needle_bags.recovery.mcap_chunk import StoredChunk
from needle_bags.recovery.mcap_records import McapScan, messages_of, read_record
from needle_bags.recovery.message_fit import MessageFit

# What an MCAP file says about the whole bag; that is written anew, too.
_BAG_RECORD: Final = "serialized_metadata"


def rewrite(data: Any, found: McapScan, stream: IO[bytes], name: str) -> DataFile:
    """Write a whole file.

    Parameters
    ----------
    data : mmap or bytes
        The damaged file.
    found : McapScan
        What is in it.
    stream : file
        The new one; synced to the disk.
    name : str
        What the file will be called.

    Raises
    ------
    OSError
        If the disk refuses it.
    """
    packed = Counter(part.compression for part in found.parts if isinstance(part, StoredChunk))
    kind = packed.most_common(1)[0][0] if packed else ""
    mcap = Writer(stream, CHUNK_SIZE, CompressionType[kind.upper() or "NONE"])
    mcap.start("ros2", LIBRARY)
    schemas = {
        number: mcap.register_schema(schema.name, schema.encoding, schema.data)
        for number, schema in found.schemas.items()
    }
    channels = {
        number: mcap.register_channel(
            channel.topic,
            channel.message_encoding,
            schemas.get(channel.schema_id, 0),
            channel.metadata,
        )
        for number, channel in found.channels.items()
    }
    written = DataFile(name)
    fit = MessageFit(found.schemas, found.channels, found.distrusted)
    for part in found.parts:
        for message in messages_of(data, part, fit):
            number = message.channel_id
            mcap.add_message(
                channels[number],
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )
            written.add(found.channels[number].topic, message.log_time)
        if not isinstance(part, StoredChunk):
            _copy_record(data, part.start, part.end, mcap)
    mcap.finish()  # type: ignore[no-untyped-call]
    stream.flush()
    os.fsync(stream.fileno())
    return written


def _copy_record(data: Any, start: int, end: int, mcap: Writer) -> None:
    if data[start] == Opcode.MESSAGE:
        return
    record = read_record(data, start, end)
    if isinstance(record, Metadata):
        if record.name != METADATA_RECORD or _BAG_RECORD not in record.metadata:
            mcap.add_metadata(record.name, record.metadata)
    elif isinstance(record, Attachment):
        mcap.add_attachment(
            record.create_time, record.log_time, record.name, record.media_type, record.data
        )
