"""Contents of a damaged MCAP file, and its records by themselves."""

from __future__ import annotations

import dataclasses
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from io import BytesIO
from typing import Any, Final

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from needle_bags.format.message_loss import DamageGaps
from needle_bags.recovery.mcap_chunk import StoredChunk
from needle_bags.recovery.message_fit import MessageFit
from needle_common.files.mcap_file import RECORD_HEADER, Index

MESSAGE: Final = struct.Struct("<HIQQ")
RECORDS: Final[dict[Opcode, Any]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}


class NotMcapError(Exception):
    """The file holds nothing of an MCAP file."""


@dataclasses.dataclass(frozen=True)
class Loose:
    """A message's, metadata's or attachment's record: where it is in the file."""

    start: int
    end: int


@dataclasses.dataclass
class McapScan:
    """Contents of a file.

    Attributes
    ----------
    size : int
        Bytes of the file.
    finished : bool
        Whether its data end as they should.
    index : Index or None
        Its index, if that is whole.
    schemas, channels : dict
        By number.
    parts : list of StoredChunk or Loose
        What is whole, in order.
    counts : Counter
        Messages that can be read, by channel.
    packed : int
        Those that were compressed by themselves.
    damage : list of Loose
        Where nothing could be read.
    mended : int
        Places that were not as they should be, and with which nothing is lost.
    gaps : DamageGaps
        Messages lost in the damage as their neighbours' numbers tell, by channel.
    distrusted : collection of int
        Channels whose definition is not that of their messages.
    """

    size: int
    finished: bool = False
    index: Index | None = None
    schemas: dict[int, Schema] = dataclasses.field(default_factory=dict)
    channels: dict[int, Channel] = dataclasses.field(default_factory=dict)
    parts: list[StoredChunk | Loose] = dataclasses.field(default_factory=list)
    counts: Counter[int] = dataclasses.field(default_factory=Counter)
    packed: int = 0
    damage: list[Loose] = dataclasses.field(default_factory=list)
    mended: int = 0
    gaps: DamageGaps = dataclasses.field(default_factory=DamageGaps)
    distrusted: Collection[int] = ()

    @property
    def bytes_lost(self) -> int:
        """Bytes of data that could not be read."""
        return sum(one.end - one.start for one in self.damage)

    @property
    def topic_counts(self) -> Counter[str]:
        """Messages that can be read, by topic."""
        found: Counter[str] = Counter()
        for number, count in self.counts.items():
            found[self.channels[number].topic] += count
        return found


def messages_of(data: Any, part: StoredChunk | Loose, fit: MessageFit) -> Iterator[Message]:
    """Yield the messages of a part that can be read."""
    if isinstance(part, StoredChunk):
        for message in part.messages(data):
            if part.is_vouched or fit.fits(message.channel_id, message.data):
                yield message
    elif data[part.start] == Opcode.MESSAGE:
        yield read_message(data, part.start, part.end)


def read_message(data: Any, start: int, end: int) -> Message:
    """Return the message whose record begins and ends at these offsets."""
    channel, sequence, log_time, publish_time = MESSAGE.unpack_from(
        data, start + RECORD_HEADER.size
    )
    content = bytes(data[start + RECORD_HEADER.size + MESSAGE.size : end])
    return Message(channel, log_time, content, publish_time, sequence)


def read_record(data: Any, start: int, end: int) -> Any:
    """Return a schema, channel, metadata or attachment; nothing may be left over of its record.

    Raises
    ------
    UNREADABLE
        If it is damaged.
    """
    stream = ReadDataStream(BytesIO(bytes(data[start + RECORD_HEADER.size : end])))
    opcode = data[start]
    if opcode == Opcode.ATTACHMENT:
        (crc,) = struct.unpack_from("<I", data, end - 4)
        if crc and zlib.crc32(data[start + RECORD_HEADER.size : end - 4]) != crc:
            raise ValueError("the attachment's checksum is wrong")
        return Attachment.read(stream)
    record: Any = RECORDS[Opcode(opcode)].read(stream)
    if stream.count != end - start - RECORD_HEADER.size:
        raise ValueError("the record is longer than what is in it")
    if isinstance(record, Schema):
        record.data.decode()  # readers take it for text
    return record
