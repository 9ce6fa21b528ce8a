"""Reader of MCAP files: returns every recorded message, or raises an error.

The format: https://mcap.dev/spec.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import yaml
from mcap.reader import SeekingReader
from mcap.records import Metadata, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from needle_core.files.file_access import open_regular
from needle_core.files.yaml_files import load_yaml

# Times [ns] are signed in ROS 2.
TIME_LIMIT: Final = 2**63


class BrokenMcapError(Exception):
    """MCAP file without an index, or whose content differs from its index."""


class McapFile:
    """Complete MCAP file, open for reading.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    BrokenMcapError
        If it was cut off, or has no index. For damaged files mcap's reader raises other errors.
    OSError
        If it cannot be read.

    Attributes
    ----------
    summary : Summary
        Index of the file.
    statistics : Statistics
        Counts and times in the index.
    """

    summary: Summary
    statistics: Statistics

    def __init__(self, path: Path) -> None:
        self._stream = open_regular(path)
        try:
            self._reader = SeekingReader(self._stream, validate_crcs=True)
            self._stream.seek(-len(MCAP0_MAGIC), os.SEEK_END)
            if self._stream.read() != MCAP0_MAGIC:
                raise BrokenMcapError("it has no footer: the recording was cut off")
            summary = self._reader.get_summary()
            if summary is None or summary.statistics is None:
                raise BrokenMcapError("it has no index")
            self.summary, self.statistics = summary, summary.statistics
        except BaseException:
            self._stream.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    @property
    def span(self) -> tuple[int, int] | None:
        """Log times of the first and the last message [ns]; None in an empty file."""
        counts = self.statistics
        span = counts.message_start_time, counts.message_end_time
        return span if counts.message_count else None

    def counts(self) -> Counter[str]:
        """Return the number of messages by topic."""
        found: Counter[str] = Counter()
        for number, count in self.statistics.channel_message_counts.items():
            found[self.summary.channels[number].topic] += count
        return found

    def definitions(self) -> dict[str, tuple[str, str]]:
        """Return encoding and text of the definition of each type."""
        schemas = self.summary.schemas.values()
        return {schema.name: (schema.encoding, schema.data.decode()) for schema in schemas}

    def topics(self) -> list[dict[str, Any]]:
        """Return the entries of metadata.yaml's `topics_with_message_count`."""
        counts, schemas = self.statistics.channel_message_counts, self.summary.schemas
        return [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": schemas[channel.schema_id].name if channel.schema_id else "",
                    "serialization_format": channel.message_encoding,
                    "offered_qos_profiles": channel.metadata.get("offered_qos_profiles"),
                    "type_description_hash": channel.metadata.get("topic_type_hash"),
                },
                "message_count": counts.get(channel.id, 0),
            }
            for channel in self.summary.channels.values()
        ]

    def metadata(self) -> list[Metadata]:
        """Return the metadata records."""
        return list(self._reader.iter_metadata())

    def read(
        self, topics: Collection[str], start: int = 0, stop: int = TIME_LIMIT
    ) -> Iterator[tuple[str, int, int, bytes]]:
        """Yield topic, log time, publish time [ns] and data: start <= log time < stop, in order.

        Raises
        ------
        BrokenMcapError
            If the file does not contain the messages that its index lists.
        """
        read_counts: Counter[str] = Counter()
        found = self._reader.iter_messages(topics, starting_at=start, ending_before=stop)
        for _, channel, message in found:
            read_counts[channel.topic] += 1
            yield channel.topic, message.log_time, message.publish_time, message.data
        first, last = self.span or (start, start)
        listed = {topic: n for topic, n in self.counts().items() if n and topic in topics}
        if start <= first and last < stop and read_counts != listed:
            raise BrokenMcapError(
                f"it holds {read_counts.total()} messages of these topics, its index lists "
                f"{sum(listed.values())}, or of others"
            )


# Name and keys of the records that rosbag2 writes.
METADATA_RECORD: Final = "rosbag2"
DISTRO_KEY: Final = "ROS_DISTRO"
METADATA_KEY: Final = "serialized_metadata"
RUN_RECORD: Final = "needle_run"


def custom_data_of(records: Iterable[Metadata]) -> dict[str, str]:
    """Return the `custom_data` of a recording from the metadata records in its files.

    The recorder writes one record about the run at its start, one for each node's parameters, one
    for each change of a parameter, and at the end, like rosbag2, the whole metadata.yaml.
    """
    custom: dict[str, str] = {}
    parameters: dict[str, Any] = {}
    changes: list[Any] = []
    whole: dict[str, Any] = {}
    for record in records:
        values = record.metadata
        if record.name == RUN_RECORD:
            custom.update(values)
        # Ignore texts that are not YAML.
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            if record.name == "parameters":
                parameters.update(load_yaml(values.get("yaml", "")))
            elif record.name == "parameter_change":
                changes.append({key: load_yaml(text) for key, text in values.items()})
            elif record.name == METADATA_RECORD and METADATA_KEY in values:
                whole = load_yaml(values[METADATA_KEY]).get("custom_data") or whole
    if parameters:
        custom["parameters"] = yaml.safe_dump(parameters)
    if changes:
        custom["parameter_changes"] = yaml.safe_dump(changes)
    return custom | {str(key): str(value) for key, value in whole.items()}


def distribution_of(records: Iterable[Metadata]) -> str:
    """Return the ROS distribution in the records; empty if there is none."""
    names = (r.metadata.get(DISTRO_KEY, "") for r in records if r.name == METADATA_RECORD)
    return next(filter(None, names), "")
