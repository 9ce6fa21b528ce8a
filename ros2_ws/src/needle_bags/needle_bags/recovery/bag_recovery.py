"""Recovery of a damaged bag: keeps everything before the first damage.

A bag of several files ends at the first damaged or missing file. A damaged file is rewritten up to
the damage, read back, and replaced; the old file is kept as `<name>.damaged`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import shutil
import struct
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePath
from typing import IO, Any, Final, NamedTuple

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from tqdm import tqdm

from needle_bags.format.bag_metadata import DataFile, bag_information, write_metadata
from needle_bags.format.bag_writer import CHUNK_SIZE, LIBRARY
from needle_core.errors import UserError
from needle_core.files.bag_directory import BagDirectory
from needle_core.files.bag_path import (
    METADATA_FILE,
    BrokenBagError,
    read_information,
    recording_files,
)
from needle_core.files.file_access import open_regular, sync_directory
from needle_core.files.mcap_file import RUN_RECORD, custom_data_of

# custom_data key: description of the loss.
_RECOVERED: Final = "recovered"
_DAMAGED: Final = ".damaged"
# Errors of mcap's reader on damaged data.
_DAMAGE: Final = (
    *(McapError, ValueError, LookupError, struct.error, OverflowError, RuntimeError),
    zstandard.ZstdError,
)
_NOTHING_LOST: Final = "its metadata or index was rebuilt; it contains everything that was written"


@dataclasses.dataclass(frozen=True)
class BagRecovery:
    """Outcome of a recovery.

    Attributes
    ----------
    was_whole : bool
        Whether the bag was complete before.
    bag : BagDirectory
        The bag after the recovery, closed.
    lost : str
        The damage and the time that follows it; empty if no message is lost.
    seconds_lost : float or None
        Time of the recording after the damage [s]; None if unknown.
    left_out : list of str
        Names of MCAP files in its folder that do not belong to the bag.
    kept : list of str
        Names of the previous files.
    """

    was_whole: bool
    bag: BagDirectory
    lost: str
    seconds_lost: float | None
    left_out: list[str]
    kept: list[str]

    @property
    def messages(self) -> int:
        """Number of messages in the bag."""
        return self.bag.counts.total()


class _Loss(NamedTuple):
    """Place of the first damage, and the loss as text and in seconds (None if unknown)."""

    where: str = ""
    text: str = ""
    seconds: float | None = 0.0


def recover_bag(path: Path) -> BagRecovery:
    """Repair a bag, or a single MCAP file.

    Parameters
    ----------
    path : Path
        Directory of the bag, one of its files, or a file to repair alone.

    Raises
    ------
    UserError
        If there is no MCAP bag, it is still being recorded, no data precede the damage, or the
        changes cannot be written. In these cases nothing is changed.
    """
    folder = path if path.is_dir() else path.parent
    metadata = _information(folder)
    names = metadata.get("relative_file_paths", ())
    listed = [folder / PurePath(str(name)).name.removesuffix(".zstd") for name in names]
    if path in listed:
        path = folder
    elif path != folder:
        metadata = {}  # metadata.yaml describes other files
    try:
        bag = _read_through(path)
    except BrokenBagError:
        files = [path] if path.is_file() else listed or recording_files(path)
        if not files or any(file.suffix != ".mcap" for file in files):
            raise
    else:
        return BagRecovery(True, bag, "", 0.0, _left_out(bag, listed), [])
    try:
        with tempfile.TemporaryDirectory(prefix=".recover.", dir=folder) as scratch:
            return _Recovery(path, files, metadata, Path(scratch)).run()
    except OSError as error:
        reason = f"{path} cannot be recovered: {error.filename or path}: {error.strerror}"
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            reason += ": the copy needs as much space again; nothing was changed"
        raise UserError(reason) from error


class _Recovery:
    """Recovery of a bag; all files are read before anything in the folder changes.

    Parameters
    ----------
    path : Path
        The bag, or a single file.
    files : list of Path
        Its files, in order.
    metadata : mapping
        Content of metadata.yaml; empty if it is missing or lists other files.
    scratch : Path
        Folder for rewritten files.
    """

    def __init__(
        self, path: Path, files: list[Path], metadata: Mapping[str, Any], scratch: Path
    ) -> None:
        self._path, self._files, self._metadata, self._scratch = path, files, metadata, scratch
        self._parts: list[BagDirectory] = []

    def run(self) -> BagRecovery:
        """Replace the bag by its content before the first damage."""
        loss = self._read()
        parts = self._parts
        if not parts:
            raise UserError(f"{self._path} cannot be recovered: it has no data before {loss.where}")
        kept: list[str] = []
        if self._path.is_dir():
            information = _new_information(parts, self._metadata, loss.text or _NOTHING_LOST)
            kept += _keep_original(self._path / METADATA_FILE)
            # Written before the data: after an interruption, recovery restarts with these files.
            write_metadata(self._path, information)
        for file, part in zip(self._files, parts, strict=False):
            if part.path.parent == self._scratch:
                kept += _keep_original(file)
                part.path.replace(file)
                sync_directory(file.parent)
        with BagDirectory(self._path) as bag:  # check the result
            left_out = _left_out(bag, self._files[: len(parts)])
            return BagRecovery(False, bag, loss.text, loss.seconds, left_out, kept)

    def _read(self) -> _Loss:
        """Read the files up to the first damage; return the loss."""
        for file in self._files:
            if not os.path.lexists(file):
                return self._loss(f"{file.name} (it is missing)", self._last)
            try:
                self._parts.append(_read_through(file))
            except BrokenBagError:
                loss = self._read_damaged(file)
                if loss.where:
                    return loss
        return _Loss()

    def _read_damaged(self, file: Path) -> _Loss:
        """Copy the records before the damage in a file to a new file; return the loss."""
        new = self._scratch / file.name
        loss = _Loss()
        with new.open("wb") as stream:
            copy = _PrefixCopy(file, stream)
            if copy.reason:
                where = f"byte {copy.end} of {file.name} ({copy.reason})"
                loss = self._loss(where, max(copy.last, self._last))
            if not copy.end or (copy.reason and not copy.messages):
                return loss
            copy.writer.add_metadata(RUN_RECORD, {_RECOVERED: loss.text or _NOTHING_LOST})
            copy.writer.finish()  # type: ignore[no-untyped-call]
            stream.flush()
            os.fsync(stream.fileno())
        shutil.copymode(file, new)
        self._parts.append(_read_through(new))
        return loss

    @property
    def _last(self) -> int:
        """Latest log time of the files read so far [ns]."""
        return max((part.end for part in self._parts), default=0)

    def _loss(self, where: str, last: int) -> _Loss:
        """Return the loss due to damage; `last` is the latest log time before it [ns]."""
        with contextlib.suppress(LookupError, TypeError):
            begin = self._metadata["starting_time"]["nanoseconds_since_epoch"]
            end = begin + self._metadata["duration"]["nanoseconds"]
            seconds = max(0, end - last) / 1e9
            return _Loss(where, f"all from {where} on: {seconds:.1f} s follow", seconds)
        text = f"all from {where} on: half a second at most if a kill ended the recording there"
        return _Loss(where, text, None)


def _information(folder: Path) -> dict[str, Any]:
    """Return the content of metadata.yaml; empty if it is unreadable or lists no files."""
    with contextlib.suppress(OSError, ValueError):
        metadata = read_information(folder)
        if metadata.get("relative_file_paths") and isinstance(
            metadata["relative_file_paths"], list
        ):
            return metadata
    return {}


def _new_information(
    parts: Sequence[BagDirectory], metadata: Mapping[str, Any], note: str
) -> dict[str, Any]:
    """Return the content of a metadata.yaml for these files."""
    files = [
        DataFile(part.path.name, part.counts, part.start if part.counts.total() else None, part.end)
        for part in parts
    ]
    topics = {name: topic for part in reversed(parts) for name, topic in part.topics.items()}
    custom = metadata.get("custom_data")
    if not isinstance(custom, dict):
        custom = custom_data_of(record for part in parts for record in part.records)
    before = str(custom.get(_RECOVERED, ""))
    if note not in before:
        custom = {**custom, _RECOVERED: "; ".join(filter(None, (before, note)))}
    distribution = parts[0].distribution or str(metadata.get("ros_distro") or "")
    is_compressed = any(part.is_compressed for part in parts)
    return bag_information(
        files, list(topics.values()), custom, distribution, is_compressed=is_compressed
    )


def _read_through(path: Path) -> BagDirectory:
    """Read all messages of a bag, and return the closed bag."""
    tqdm.monitor_interval = 0  # no monitor thread
    with BagDirectory(path) as bag:
        messages, total = bag.messages(lambda _: True), bag.counts.total()
        for _ in tqdm(messages, path.name, total, leave=False, delay=1.0, disable=None):
            pass
    return bag


def _left_out(bag: BagDirectory, taken: Sequence[Path]) -> list[str]:
    """Return the names of the MCAP files in the bag's folder that do not belong to it."""
    return [file.name for file in sorted(set(bag.path.glob("[!.]*.mcap")).difference(taken))]


def _keep_original(path: Path) -> list[str]:
    """Keep a file under a second name; return that name."""
    if not os.path.lexists(path):
        return []
    kept = path.with_name(path.name + _DAMAGED)
    number = 1
    while os.path.lexists(kept):
        number += 1
        kept = path.with_name(f"{path.name}{_DAMAGED}{number}")
    try:
        os.link(path, kept, follow_symlinks=False)
    except OSError:
        path.rename(kept)
    return [kept.name]


class _PrefixCopy:
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
        If the copy cannot be written.

    Attributes
    ----------
    writer : Writer
        Writer of the copy.
    end : int
        Position of the damage [B]; 0 if there is no intact record.
    reason : str
        The kind of damage; empty if the data end properly.
    messages, last : int
        Number of messages in the copy, and their latest log time [ns].
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
