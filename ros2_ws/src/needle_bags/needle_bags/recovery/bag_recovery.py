"""Makes a bag whole of what can be read in it; nothing of what was there is destroyed.

Every file that is not whole is written anew beside itself, read back, and put in its place; the old
one stays as `<name>.damaged` until somebody deletes it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import mmap
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata
from tqdm import tqdm

from needle_bags.format.bag_metadata import (
    METADATA_RECORD,
    DataFile,
    bag_information,
    to_yaml,
    write_metadata,
)
from needle_bags.format.bag_writer import DISTRO_KEY
from needle_bags.recovery.bag_losses import Losses, find_losses
from needle_bags.recovery.mcap_records import Loose, McapScan, NotMcapError, read_record
from needle_bags.recovery.mcap_rewrite import rewrite
from needle_bags.recovery.mcap_scan import scan
from needle_bags.recovery.message_fit import type_hash
from needle_common.errors import UserError
from needle_common.files.bag_directory import (
    METADATA_FILE,
    BagDirectory,
    is_being_recorded,
    read_information,
    require_directory,
)
from needle_common.files.bag_topic import BagTopic, offered_profiles
from needle_common.files.file_access import open_regular, sync_directory
from needle_common.files.mcap_file import BrokenMcapError, McapFile
from needle_common.files.plain_yaml import load_plain

# Keys of `custom_data`, and of the records that the recorder leaves in the data for it.
RECOVERED: Final = "recovered"
RUN_RECORD: Final = "needle_run"
PARAMETERS: Final = "parameters"
PARAMETER_CHANGE: Final = "parameter_change"
PARAMETER_CHANGES: Final = "parameter_changes"
DAMAGED: Final = ".damaged"
_NUMBER: Final = re.compile(r"_(\d+)\.mcap$")


@dataclasses.dataclass(frozen=True)
class BagRecovery:
    """Outcome of a recovery.

    Attributes
    ----------
    was_whole : bool
        Whether nothing had to be done.
    files : dict of str to DataFile
        What the bag holds now, by file name.
    topics : int
        Topics in it.
    losses : Losses
        What it no longer holds.
    kept : list of str
        The damaged files, beside the bag's.
    """

    was_whole: bool
    files: dict[str, DataFile]
    topics: int
    losses: Losses
    kept: list[str]

    @property
    def messages(self) -> int:
        """Messages in the bag."""
        return sum(file.message_count for file in self.files.values())

    @property
    def bytes_lost(self) -> int:
        """Bytes of data that could not be read."""
        return sum(self.losses.bytes.values())


@dataclasses.dataclass
class _File:
    """A data file: what is in it, and whether it stays."""

    path: Path
    found: McapScan
    metadata: list[Metadata]
    content: DataFile | None = None
    new: Path | None = None


def recover_bag(path: Path) -> BagRecovery:
    """Make a bag whole; on a terminal, a bar shows how far a file is that takes a while.

    Parameters
    ----------
    path : Path
        The bag's directory.

    Raises
    ------
    UserError
        If there is no MCAP bag, it is still being recorded, nothing in it can be read, or the disk
        refuses the changes; the bag is as it was then.
    """
    names = _data_files(path)
    with contextlib.ExitStack() as stack:
        try:
            return _recover(path, names, stack)
        except (NotMcapError, BrokenMcapError) as error:
            raise UserError(f"{path} cannot be recovered: {error}") from error
        except OSError as error:
            raise UserError(_refused(path, error)) from error


def _recover(path: Path, names: Sequence[Path], stack: contextlib.ExitStack) -> BagRecovery:
    old, is_readable = _old_information(path)
    files: list[_File] = []
    foreign: list[Path] = []
    reasons: list[NotMcapError] = []
    for name in names:
        try:
            files.append(_look_at(name, stack))
        except NotMcapError as error:
            reasons.append(error)
            foreign.append(name)
    if not files:
        raise reasons[0]
    content = {file.path.name: file.content for file in files if file.content is not None}
    topics: dict[str, BagTopic] = {}
    for file in files:
        for channel in file.found.channels.values():
            topics.setdefault(channel.topic, _topic(channel, file.found))
    is_packed = any(file.found.packed for file in files)
    is_told = is_readable and _agrees(old, list(content.values()), topics, is_packed)
    is_changed = bool(foreign) or any(file.new is not None for file in files)
    losses = find_losses(
        old, {file.path.name: file.found for file in files}, [file.name for file in foreign]
    )
    if is_told and not is_changed and _opens(path):
        return BagRecovery(True, content, len(topics), losses, [])
    custom: dict[str, str] = {str(k): str(v) for k, v in (old.get("custom_data") or {}).items()}
    if not is_readable:
        _collect(custom, [record for file in files for record in file.metadata])
    custom[RECOVERED] = "; ".join(filter(None, (custom.get(RECOVERED), losses.text())))
    records = [record for file in files for record in file.metadata]
    distribution = _distribution(records) or str(old.get("ros_distro") or "")
    kept = [_set_aside(file) for file in foreign]
    for file in files:
        if file.new is not None:
            kept.append(_set_aside(file.path, file.new))
    if is_changed or not is_told:
        kept += _set_aside_metadata(path)
    information = bag_information(
        list(content.values()), list(topics.values()), custom, distribution, is_packed=is_packed
    )
    write_metadata(path, information)
    with BagDirectory(path):  # what is left must be what every tool reads
        pass
    return BagRecovery(False, content, len(topics), losses, kept)


def _look_at(path: Path, stack: contextlib.ExitStack) -> _File:
    """Read a file, and write it anew beside itself if it is not whole."""
    with open_regular(path) as stream, _mapped(stream.fileno()) as data:
        try:
            with _bar(path.name, len(data)) as bar:
                found = scan(data, lambda done: bar.update(done - bar.n))
        except NotMcapError as error:
            raise NotMcapError(f"{path.name}: {error}") from error
        records = [
            read_record(data, part.start, part.end)
            for part in found.parts
            if isinstance(part, Loose) and data[part.start] == Opcode.METADATA
        ]
        file = _File(path, found, records)
        if found.finished and not found.damage and not found.mended:
            file.content = _content(path, found)
        if file.content is None:
            new = _beside(path, stack)
            with new.open("wb") as target:
                written = rewrite(data, found, target, path.name)
            shutil.copymode(path, new)
            file.content = _content(new, found, path.name)
            if file.content != written:
                raise BrokenMcapError(f"{path.name}: what was written anew is not what was read")
            file.new = new
    return file


def _bar(name: str, size: int) -> tqdm[NoReturn]:
    tqdm.monitor_interval = 0  # its thread would outlive the bar
    return tqdm(
        total=size, desc=name, unit="B", unit_scale=True, delay=1.0, leave=False, disable=None
    )


def _content(path: Path, found: McapScan, name: str = "") -> DataFile | None:
    """Return what every tool reads from a file; None if it is not all that is in it."""
    try:
        file = McapFile(path)
    except BrokenMcapError:
        return None
    with contextlib.closing(file):
        content = DataFile(name or path.name)
        summary = file.summary
        try:
            for topic, log_time, _, _ in file.read([c.topic for c in summary.channels.values()]):
                content.add(topic, log_time)
        except BrokenMcapError:
            return None
        indexed = len(summary.metadata_indexes) in (0, file.statistics.metadata_count)
        return content if indexed and content.counts == +found.topic_counts else None


def _beside(path: Path, stack: contextlib.ExitStack) -> Path:
    """Return a new file beside one, gone in the end unless it is put somewhere."""
    space = shutil.disk_usage(path.parent).free
    if space < path.stat().st_size:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    number, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    os.close(number)
    stack.callback(Path(name).unlink, missing_ok=True)
    return Path(name)


def _set_aside(path: Path, new: Path | None = None) -> str:
    """Keep a file under another name, and put a new one in its place; return that name."""
    kept = path.with_name(path.name + DAMAGED)
    number = 1
    while os.path.lexists(kept):
        number += 1
        kept = path.with_name(f"{path.name}{DAMAGED}{number}")
    if new is None:
        path.rename(kept)
    else:
        # There is a file of this name at every moment.
        try:
            os.link(path, kept, follow_symlinks=False)
        except OSError:
            path.rename(kept)
        new.replace(path)
    sync_directory(path.parent)
    return kept.name


def _set_aside_metadata(path: Path) -> list[str]:
    metadata = path / METADATA_FILE
    return [_set_aside(metadata)] if os.path.lexists(metadata) else []


def _opens(path: Path) -> bool:
    try:
        with BagDirectory(path) as bag:
            bag.typestore()
    except UserError:
        return False
    return True


def _refused(path: Path, error: OSError) -> str:
    reason = f"{path} cannot be recovered: {error.filename or path}: {error.strerror}"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        reason += ": it is written anew, which takes as much room; nothing was changed"
    return reason


@contextlib.contextmanager
def _mapped(number: int) -> Iterator[Any]:
    if not os.fstat(number).st_size:
        yield b""
        return
    with mmap.mmap(number, 0, access=mmap.ACCESS_READ) as data:
        yield data


def _data_files(path: Path) -> list[Path]:
    require_directory(path)
    files = sorted(path.glob("*.mcap"), key=_order)
    if not files:
        if any(path.glob("*.db3")):
            raise UserError(f"{path} is an SQLite bag: run `ros2 bag reindex {path}`")
        if any(path.glob("*.mcap.zstd")):
            raise UserError(
                f"{path}: its files are compressed as a whole: run `unzstd --rm {path}/*.mcap.zstd`"
            )
        raise UserError(f"{path} is not a bag: it has no .mcap file")
    for file in files:
        if is_being_recorded(file):
            raise UserError(f"{path}: the bag is still being recorded: end the recorder first")
    return files


def _order(file: Path) -> tuple[int, str]:
    number = _NUMBER.search(file.name)
    return (int(number[1]) if number else 0, file.name)


def _old_information(path: Path) -> tuple[dict[str, Any], bool]:
    """Return what metadata.yaml says, and whether it can be read."""
    try:
        return read_information(path), True
    except (OSError, ValueError):
        return {}, False


def _agrees(
    old: Mapping[str, Any],
    files: Sequence[DataFile],
    topics: Mapping[str, BagTopic],
    is_packed: bool,
) -> bool:
    """Return whether metadata.yaml tells of just these files, topics, types, counts and times."""
    if (str(old.get("compression_mode")).lower() == "message") is not is_packed:
        return False
    counts: Counter[str] = Counter()
    for file in files:
        counts.update(file.counts)
    new = bag_information(files, list(topics.values()), {}, "")
    try:
        told = {
            str(entry["topic_metadata"]["name"]): entry
            for entry in old["topics_with_message_count"]
        }
        return (
            [Path(str(name)).name for name in old["relative_file_paths"]]
            == [file.name for file in files]
            and all(old[key] == new[key] for key in ("message_count", "duration", "starting_time"))
            and [(f["path"], f["message_count"]) for f in old.get("files") or new["files"]]
            == [(f["path"], f["message_count"]) for f in new["files"]]
            and {name for name, count in counts.items() if count} <= set(told)
            and all(entry["message_count"] == counts[name] for name, entry in told.items())
            and all(
                entry["topic_metadata"]["type"] == topics[name].type_name
                and (entry["topic_metadata"].get("type_description_hash") or topics[name].type_hash)
                == topics[name].type_hash
                for name, entry in told.items()
                if name in topics
            )
        )
    except (KeyError, TypeError):
        return False


def _topic(channel: Channel, found: McapScan) -> BagTopic:
    schema = found.schemas.get(channel.schema_id)
    told = channel.metadata.get("topic_type_hash", "")
    return BagTopic(
        channel.topic,
        schema.name if schema is not None else "__schemaless__",
        schema.data.decode() if schema is not None else "",
        told or ("" if schema is None else type_hash(schema)),
        offered_profiles(channel.metadata.get("offered_qos_profiles", "")),
    )


def _distribution(records: Sequence[Metadata]) -> str:
    for record in records:
        if record.name == METADATA_RECORD and DISTRO_KEY in record.metadata:
            return str(record.metadata[DISTRO_KEY])
    return ""


def _collect(custom: dict[str, str], records: Sequence[Metadata]) -> None:
    """Take from the records in the data what the recorder would have put into metadata.yaml."""
    parameters: dict[str, Any] = {}
    changes: list[Any] = []
    for record in records:
        if record.name == RUN_RECORD:
            custom.update(record.metadata)
            continue
        with contextlib.suppress(ValueError, TypeError):
            if record.name == PARAMETERS:
                parameters.update(load_plain(record.metadata.get("yaml", "")) or {})
            elif record.name == PARAMETER_CHANGE:
                changes.append({key: load_plain(text) for key, text in record.metadata.items()})
    if parameters:
        custom[PARAMETERS] = to_yaml(parameters)
    if changes:
        custom[PARAMETER_CHANGES] = to_yaml(changes)
