"""Rosbag2 directory; opening it fails if its content does not agree with its metadata."""

from __future__ import annotations

import contextlib
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple

from mcap.records import Metadata
from rosbags.rosbag2 import Reader
from rosbags.typesys.store import Typestore

from needle_core.errors import UserError
from needle_core.files.bag_data import SqliteData, is_compressed, unpack, unpack_file
from needle_core.files.bag_path import METADATA_FILE, read_information, readable, require_bag
from needle_core.files.bag_topic import BagTopic, offered_profiles, typestore_of
from needle_core.files.file_access import open_regular
from needle_core.files.mcap_file import TIME_LIMIT, McapFile, custom_data_of, distribution_of

_NEWEST_VERSION: Final = 9


class SentMessage(NamedTuple):
    """Message of a bag.

    Attributes
    ----------
    time, log_time : int
        Send time (receive time if the bag has none) and receive time [ns].
    topic, type_name : str
        Topic and type.
    data : bytes
        The message as CDR.
    """

    time: int
    log_time: int
    topic: str
    type_name: str
    data: bytes


class BagDirectory:
    """Bag open for reading; the attributes stay valid after it is closed.

    Parameters
    ----------
    path : Path
        Rosbag2 directory (MCAP or SQLite), or a single MCAP file.

    Raises
    ------
    BrokenBagError
        If it is damaged or incomplete.
    UserError
        If it does not exist, or its format is not supported.

    Attributes
    ----------
    topics : dict of str to BagTopic
        Topics by name.
    counts : dict of str to int
        Number of messages by topic.
    custom_data : dict of str to str
        Custom data of the recorder, from metadata.yaml or the file.
    distribution : str
        ROS distribution of the recording; empty if unknown.
    start, end : int
        Log times of the first and the last message [ns]; 0 in an empty bag.
    records : list of Metadata
        Metadata records of a single MCAP file.
    is_compressed : bool
        Whether any message read so far was compressed individually.
    """

    def __init__(self, path: Path) -> None:
        require_bag(path)
        self.path = path
        self.is_compressed = False
        self.records: list[Metadata] = []
        self._stack = contextlib.ExitStack()
        try:
            with readable(path):
                if path.is_dir():
                    self._open_directory()
                else:
                    self._open_file()
                spans = [file.span for file in self._files if file.span is not None]
                self.start = min((first for first, _ in spans), default=0)
                self.end = max((last for _, last in spans), default=0)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> BagDirectory:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def messages(
        self, is_selected: Callable[[str], bool], start: int = 0, stop: int = TIME_LIMIT
    ) -> Iterator[SentMessage]:
        """Yield the messages of selected topics with start <= log time < stop [ns], in order.

        Raises
        ------
        UserError
            If the messages do not agree with the metadata.
        """
        topics = {name for name in self.topics if is_selected(name)}
        with readable(self.path):
            for file in self._files:
                for topic, log_time, sent, data in file.read(topics, start, stop):
                    self.is_compressed |= is_compressed(data)
                    plain = unpack(data) if is_compressed(data) else data
                    type_name = self.topics[topic].type_name
                    yield SentMessage(sent, log_time, topic, type_name, plain)

    def typestore(self) -> Typestore:
        """Return the types that the bag defines; those of Jazzy if it defines none."""
        return typestore_of(
            tuple(
                (topic.encoding, topic.definition, topic.type_name, topic.type_hash)
                for topic in self.topics.values()
                if topic.definition
            )
        )

    def deserialize(self, store: Typestore, message: SentMessage) -> Any:
        """Return the content of a message.

        Raises
        ------
        UserError
            If it does not fit its definition.
        """
        try:
            return store.deserialize_cdr(message.data, message.type_name)
        # rosbags' generated code raises all kinds of errors for bytes of another type.
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
            raise UserError(
                f"{self.path}: a message of {message.topic} does not match its definition "
                f"({reason}): recorded so, or damaged without a checksum"
            ) from error

    def _open_directory(self) -> None:
        information = read_information(self.path)
        version = information.get("version")
        if not isinstance(version, int):
            raise ValueError(f"{METADATA_FILE} has version {version!r}")
        try:
            kind = self._require_known(information)
            # Old versions prefix the file names with the bag's name.
            names = [PurePath(name).name for name in information["relative_file_paths"]]
            self._files = [self._open(self.path / name, kind) for name in names]
            custom = information.get("custom_data") or {}
            self.custom_data = {str(key): str(value) for key, value in custom.items()}
            self.distribution = str(information.get("ros_distro") or "")
            self._read_topics(information["topics_with_message_count"])
            total = information["message_count"]
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            if version <= _NEWEST_VERSION:
                raise
            raise UserError(
                f"{self.path}: {METADATA_FILE} has version {version}, supported up to version "
                f"{_NEWEST_VERSION}; the bag may be intact"
            ) from error
        self._compare(total)

    def _open_file(self) -> None:
        file = self._open(self.path, "mcap")
        assert isinstance(file, McapFile)
        self._files = [file]
        self.records = file.metadata()
        self.custom_data = custom_data_of(self.records)
        self.distribution = distribution_of(self.records)
        self._read_topics(file.topics())

    def _require_known(self, information: Mapping[str, Any]) -> str:
        """Return the storage type; raise a `UserError` for unsupported formats."""
        kind = str(information["storage_identifier"])
        mode = str(information.get("compression_mode") or "none").lower()
        packing = str(information.get("compression_format") or "zstd").lower()
        if kind not in ("mcap", "sqlite3"):
            raise UserError(f"{self.path}: its storage {kind!r} is not supported")
        if mode != "none" and packing != "zstd":
            raise UserError(f"{self.path}: its compression {packing!r} is not supported")
        return kind

    def _open(self, path: Path, kind: str) -> McapFile | SqliteData:
        if path.suffix == ".zstd":
            folder = self._stack.enter_context(tempfile.TemporaryDirectory())
            path = unpack_file(path, Path(folder))
        if kind == "mcap":
            file = McapFile(path)
            self._stack.callback(file.close)
            return file
        open_regular(path).close()
        return SqliteData(self._stack.enter_context(Reader(path)))

    def _read_topics(self, entries: Sequence[Mapping[str, Any]]) -> None:
        definitions: dict[str, tuple[str, str]] = {}
        for file in self._files:
            for name, definition in file.definitions().items():
                definitions.setdefault(name, definition)
        self.counts: Counter[str] = Counter()
        self.topics: dict[str, BagTopic] = {}
        for entry in entries:
            metadata = entry["topic_metadata"]
            name, type_name = str(metadata["name"]), str(metadata["type"])
            if metadata.get("serialization_format", "cdr") != "cdr":
                raise UserError(f"{self.path}: {name} is not in CDR, the only supported encoding")
            known = self.topics.get(name)
            if known is not None and known.type_name != type_name:
                raise UserError(
                    f"{self.path}: {name} has two types in this bag, {known.type_name} and "
                    f"{type_name}: record them under two names"
                )
            self.counts[name] += int(entry["message_count"])
            type_hash = str(metadata.get("type_description_hash") or "")
            qos = offered_profiles(metadata.get("offered_qos_profiles") or [])
            encoding, text = definitions.get(type_name, ("ros2msg", ""))
            self.topics[name] = BagTopic(name, type_name, text, type_hash, qos, encoding)

    def _compare(self, total: int) -> None:
        found: Counter[str] = Counter()
        for file in self._files:
            found.update(file.counts())
        if +self.counts != +found or total != found.total():
            raise ValueError(
                f"{METADATA_FILE} lists {self.counts.total()} messages, the data has "
                f"{found.total()}, or of others"
            )
