"""Makes a bag whole that a crash, a kill or a full disk left behind."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import yaml
from mcap.records import Channel

from needle_bringup.bag_metadata import (
    METADATA_RECORD,
    BagTopic,
    DataFile,
    OfferedQos,
    bag_information,
    write_metadata,
)
from needle_bringup.bag_writer import DISTRO_KEY, LIBRARY
from needle_bringup.mcap_repair import FileRecovery, repair, scan_file
from needle_bringup.mcap_scan import McapScan, NotMcapError
from needle_common.bag_directory import METADATA_FILE, is_being_recorded
from needle_common.errors import UserError

# Keys of `custom_data`, and of the records that the recorder leaves in the data for it.
RECOVERED: Final = "recovered"
RUN_RECORD: Final = "needle_run"
PARAMETERS: Final = "parameters"
PARAMETER_CHANGE: Final = "parameter_change"
PARAMETER_CHANGES: Final = "parameter_changes"
_NUMBER: Final = re.compile(r"_(\d+)\.mcap$")

Progress = Callable[[Path, int], None]


@dataclasses.dataclass(frozen=True)
class BagRecovery:
    """What became of a bag.

    Attributes
    ----------
    was_whole : bool
        Whether nothing had to be done.
    files : dict of str to FileRecovery
        By file name.
    messages, topics : int
        What the bag holds now.
    """

    was_whole: bool
    files: dict[str, FileRecovery]
    messages: int
    topics: int

    @property
    def bytes_lost(self) -> int:
        """Bytes of data that could not be read."""
        return sum(file.bytes_lost for file in self.files.values())

    @property
    def salvaged(self) -> int:
        """Messages from a chunk that was cut."""
        return sum(file.salvaged for file in self.files.values())

    def losses(self) -> list[str]:
        """Return what was lost, one sentence a file."""
        found = []
        for name, file in self.files.items():
            if file.bytes_lost:
                found.append(f"{name}: {file.bytes_lost} bytes could not be read")
            if file.chunks_given_back:
                found.append(
                    f"{name}: the last {file.chunks_given_back} chunks made room for the index"
                )
        return found


def recover_bag(path: Path, progress: Progress | None = None) -> BagRecovery:
    """Make a bag whole, where it is.

    Parameters
    ----------
    path : Path
        The bag's directory.
    progress : callable, optional
        Called with the file and the bytes of it that were read, now and then.

    Raises
    ------
    UserError
        If there is no MCAP bag, it is still being recorded, or the disk refuses the changes.
    """
    files = _data_files(path)
    try:
        return _recover(path, files, progress)
    except NotMcapError as error:
        raise UserError(f"{path} cannot be recovered: {error}") from error
    except OSError as error:
        raise UserError(
            f"{path} cannot be recovered: {error.filename or path}: {error.strerror}"
        ) from error


def _recover(path: Path, files: Sequence[Path], progress: Progress | None) -> BagRecovery:
    old = _old_information(path)
    recoveries: dict[str, FileRecovery] = {}
    data_files: list[DataFile] = []
    topics: dict[str, BagTopic] = {}
    left_behind: dict[str, str] = {}
    distribution = ""
    for file in files:
        found = _scan(file, progress)
        recoveries[file.name] = repair(file, found, library=LIBRARY)
        data_files.append(_data_file(file, found))
        for channel in found.channels.values():
            topics.setdefault(channel.topic, _topic(channel, found))
        distribution = distribution or _distribution(found)
        _collect(left_behind, found)
    custom = left_behind if old is None else dict(old.get("custom_data") or {})
    result = BagRecovery(
        was_whole=all(r.was_whole for r in recoveries.values()) and _agrees(old, data_files),
        files=recoveries,
        messages=sum(file.message_count for file in data_files),
        topics=len(topics),
    )
    if not result.was_whole:
        lost = "; ".join(result.losses())
        custom[RECOVERED] = lost or "the recording was not completed; all that was written is here"
        distribution = distribution or str((old or {}).get("ros_distro") or "")
        write_metadata(
            path, bag_information(data_files, list(topics.values()), custom, distribution)
        )
    (path / f"{METADATA_FILE}.tmp").unlink(missing_ok=True)
    return result


def _data_files(path: Path) -> list[Path]:
    if path.is_file():
        raise UserError(f"{path} is a file: name the bag's directory, {path.absolute().parent}")
    if not path.is_dir():
        raise UserError(f"{path}: no such bag directory")
    files = sorted(path.glob("*.mcap"), key=_order)
    if not files:
        if any(path.glob("*.db3")):
            raise UserError(f"{path} is an SQLite bag: run `ros2 bag reindex {path}`")
        raise UserError(f"{path} is not a bag: it has no .mcap file")
    for file in files:
        if is_being_recorded(file):
            raise UserError(f"{path}: the bag is still being recorded: end the recorder first")
    return files


def _order(file: Path) -> tuple[int, str]:
    number = _NUMBER.search(file.name)
    return (int(number[1]) if number else 0, file.name)


def _scan(file: Path, progress: Progress | None) -> McapScan:
    try:
        return scan_file(file, None if progress is None else lambda done: progress(file, done))
    except NotMcapError as error:
        raise NotMcapError(f"{file.name}: {error}") from error


def _old_information(path: Path) -> dict[str, Any] | None:
    """Return what metadata.yaml says; None if it is missing or broken."""
    try:
        document = yaml.safe_load((path / METADATA_FILE).read_text(encoding="utf-8"))
        information = document["rosbag2_bagfile_information"]
        return information if isinstance(information, dict) else None
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        return None


def _agrees(old: Mapping[str, Any] | None, files: Sequence[DataFile]) -> bool:
    """Return whether metadata.yaml tells of just these files and their messages."""
    return (
        old is not None
        and old.get("relative_file_paths") == [file.name for file in files]
        and old.get("message_count") == sum(file.message_count for file in files)
    )


def _data_file(file: Path, found: McapScan) -> DataFile:
    counts: dict[str, int] = {}
    for number, count in found.counts.items():
        topic = found.channels[number].topic
        counts[topic] = counts.get(topic, 0) + count
    return DataFile(file.name, counts, *found.times)


def _topic(channel: Channel, found: McapScan) -> BagTopic:
    schema = found.schemas.get(channel.schema_id)
    try:
        profiles = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
        offered = tuple(OfferedQos.from_rosbag2(profile) for profile in profiles)
    except (ValueError, TypeError, KeyError, IndexError, yaml.YAMLError):
        offered = ()
    return BagTopic(
        channel.topic,
        schema.name if schema is not None else "__schemaless__",
        schema.data.decode() if schema is not None else "",
        channel.metadata.get("topic_type_hash", ""),
        offered,
    )


def _distribution(found: McapScan) -> str:
    for record in found.metadata:
        if record.name == METADATA_RECORD and DISTRO_KEY in record.metadata:
            return record.metadata[DISTRO_KEY]
    return ""


def _collect(custom: dict[str, str], found: McapScan) -> None:
    """Take from the records in the data what the recorder would have put into metadata.yaml."""
    parameters: dict[str, Any] = yaml.safe_load(custom.get(PARAMETERS, "")) or {}
    changes: list[Any] = yaml.safe_load(custom.get(PARAMETER_CHANGES, "")) or []
    for record in found.metadata:
        if record.name == RUN_RECORD:
            custom.update(record.metadata)
        elif record.name == PARAMETERS:
            parameters.update(yaml.safe_load(record.metadata.get("yaml", "")) or {})
        elif record.name == PARAMETER_CHANGE:
            changes.append({key: yaml.safe_load(text) for key, text in record.metadata.items()})
    if parameters:
        custom[PARAMETERS] = yaml.safe_dump(parameters)
    if changes:
        custom[PARAMETER_CHANGES] = yaml.safe_dump(changes)
