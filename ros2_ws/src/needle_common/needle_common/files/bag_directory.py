"""Opens a rosbag2 directory: what it says is in it is what is read, or an error."""

from __future__ import annotations

import contextlib
import fcntl
import functools
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path, PurePath
from typing import Any, Final, NamedTuple

from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from needle_common.errors import UserError
from needle_common.files.bag_data import SqliteData, unpack, unpack_file
from needle_common.files.bag_topic import BagTopic, offered_profiles
from needle_common.files.file_access import open_regular
from needle_common.files.mcap_file import TIME_LIMIT, McapFile
from needle_common.files.plain_yaml import load_plain

METADATA_FILE: Final = "metadata.yaml"
METADATA_LIMIT: Final = 2**24
_NEWEST_VERSION: Final = 9
# A rig's definitions take 0.2 s to be understood, and a bag is read several times.
_STORES_KEPT: Final = 4
_PARTS_KEPT: Final = 256
_NEXT_TYPE: Final = re.compile(r"^={80}\nMSG: ", re.MULTILINE)


class SentMessage(NamedTuple):
    """A message as it is in the bag.

    Attributes
    ----------
    time, log_time : int
        When it was sent (received, where the bag does not tell) and received [ns].
    topic, type_name : str
        Its topic and type.
    data : bytes
        The message as CDR.
    """

    time: int
    log_time: int
    topic: str
    type_name: str
    data: bytes


def recover_hint(path: Path) -> str:
    """Return what to type for a bag that is not whole."""
    return f"run `ros2 run needle_bags recover {path}`"


def require_directory(path: Path) -> None:
    """Raise a `UserError` if a path that is to be a bag is no directory."""
    if path.is_file():
        part = path.suffix == ".mcap" or path.name == METADATA_FILE
        meant = f", {path.absolute().parent}" if part else ""
        raise UserError(f"{path} is a file: name the bag's directory{meant}")
    if not path.is_dir():
        raise UserError(f"{path}: no such bag directory")


def require_bag(path: Path) -> None:
    """Raise a `UserError` if a path is no bag with metadata.yaml."""
    require_directory(path)
    if os.path.lexists(path / METADATA_FILE):
        return
    if any(is_being_recorded(file) for file in path.glob("*.mcap")):
        raise UserError(f"{path}: the bag is still being recorded")
    if any(path.glob("*.mcap")):
        raise UserError(
            f"{path}: the bag was not completed ({METADATA_FILE} is missing): {recover_hint(path)}"
        )
    if any(path.glob("*.db3")):
        raise UserError(f"{path}: {METADATA_FILE} is missing: run `ros2 bag reindex {path}`")
    raise UserError(f"{path} is not a bag: it has no {METADATA_FILE}")


def is_being_recorded(file: Path) -> bool:
    """Return whether a recorder is writing a data file right now."""
    try:
        with open_regular(file) as stream:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@contextlib.contextmanager
def readable(path: Path) -> Iterator[None]:
    """Turn whatever a bag's content makes a reader raise into one line."""
    try:
        yield
    except (UserError, GeneratorExit):
        raise
    # Readers meet broken bags with all kinds of exceptions: assertions, struct errors, KeyError...
    except Exception as error:
        lines = str(error).splitlines()
        reason = lines[0].rstrip(".")[:200] if lines else type(error).__name__
        if isinstance(error, OSError):
            reason = error.strerror or reason
            if error.filename:
                reason = f"{PurePath(os.fsdecode(error.filename)).name}: {reason}"
        raise UserError(f"{path}: the bag is broken ({reason}): {recover_hint(path)}") from error


def read_information(path: Path) -> dict[str, Any]:
    """Return metadata.yaml's content.

    Raises
    ------
    OSError, ValueError
        If it cannot be read, or is not what rosbag2 writes.
    """
    with open_regular(path / METADATA_FILE) as stream:
        data = stream.read(METADATA_LIMIT + 1)
    if len(data) > METADATA_LIMIT:
        raise ValueError(f"{METADATA_FILE} is larger than {METADATA_LIMIT} bytes")
    try:
        document = load_plain(data.decode())
    except ValueError as error:
        raise ValueError(f"{METADATA_FILE}: {error}") from error
    information = document.get("rosbag2_bagfile_information") if isinstance(document, dict) else 0
    if not isinstance(information, dict):
        raise ValueError(f"{METADATA_FILE} is not what rosbag2 writes")
    return information


class BagDirectory:
    """A bag open for reading; what it says about itself stays known when it is closed.

    Parameters
    ----------
    path : Path
        A rosbag2 directory, MCAP or SQLite.

    Raises
    ------
    UserError
        If there is none, it is not whole, or it holds what nothing should be read from.

    Attributes
    ----------
    information : dict
        metadata.yaml's content.
    topics : dict of str to BagTopic
        By name.
    counts : dict of str to int
        Messages for each topic.
    custom_data : dict of str to str
        What the recorder left in metadata.yaml.
    distribution : str
        ROS distribution it was recorded with; empty where not known.
    start, end : int
        Log times of the first and the last message [ns]; 0 in an empty bag.
    """

    def __init__(self, path: Path) -> None:
        require_bag(path)
        self.path = path
        self._stack = contextlib.ExitStack()
        try:
            with readable(path):
                self.information = read_information(path)
                self._files = [self._open(name) for name in self._file_names()]
                custom = self.information.get("custom_data") or {}
                self.custom_data = {str(key): str(value) for key, value in custom.items()}
                self.distribution = str(self.information.get("ros_distro") or "")
                self.counts: Counter[str] = Counter()
                self.topics = self._read_topics()
                self._compare()
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
        self, wanted: Callable[[str], bool], start: int = 0, stop: int = TIME_LIMIT
    ) -> Iterator[SentMessage]:
        """Yield the messages of wanted topics with start <= log time < stop [ns], in order.

        Raises
        ------
        UserError
            If the bag holds other messages than it says.
        """
        topics = {name for name in self.topics if wanted(name)}
        packed = self._mode() == "message"
        with readable(self.path):
            for file in self._files:
                for topic, log_time, sent, data in file.read(topics, start, stop):
                    plain = unpack(data) if packed else data
                    type_name = self.topics[topic].type_name
                    yield SentMessage(sent, log_time, topic, type_name, plain)

    def typestore(self) -> Typestore:
        """Return the types that the bag defines, to be read; Jazzy's if it defines none."""
        return _typestore(
            tuple(
                (topic.encoding, topic.definition, topic.type_name, topic.type_hash)
                for topic in self.topics.values()
                if topic.definition
            )
        )

    def deserialize(self, store: Typestore, message: SentMessage) -> Any:
        """Return a message's content.

        Raises
        ------
        UserError
            If it does not fit its definition.
        """
        try:
            return store.deserialize_cdr(message.data, message.type_name)
        # whatever rosbags' generated code meets in bytes of another type
        except Exception as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0].rstrip(".")
            raise UserError(
                f"{self.path}: a message of {message.topic} does not fit its definition "
                f"({reason}): recorded so, or damaged: {recover_hint(self.path)}"
            ) from error

    def _file_names(self) -> list[str]:
        version = self.information.get("version")
        if not isinstance(version, int) or version > _NEWEST_VERSION:
            raise ValueError(f"{METADATA_FILE} is of version {version!r}")
        names = self.information["relative_file_paths"]
        # Old versions put the bag's own name first.
        return [PurePath(str(name)).name for name in names]

    def _mode(self) -> str:
        return str(self.information.get("compression_mode") or "none").lower()

    def _open(self, name: str) -> McapFile | SqliteData:
        path = self.path / name
        if self._mode() == "file":
            folder = self._stack.enter_context(tempfile.TemporaryDirectory())
            path = unpack_file(path, Path(folder))
        kind = self.information["storage_identifier"]
        if kind == "mcap":
            file = McapFile(path)
            self._stack.callback(file.close)
            return file
        if kind == "sqlite3":
            open_regular(path).close()
            return SqliteData(self._stack.enter_context(Reader(path)))
        raise ValueError(f"its storage is {kind!r}")

    def _read_topics(self) -> dict[str, BagTopic]:
        definitions: dict[str, tuple[str, str]] = {}
        for file in self._files:
            for name, definition in file.definitions().items():
                definitions.setdefault(name, definition)
        topics: dict[str, BagTopic] = {}
        for entry in self.information["topics_with_message_count"]:
            told = entry["topic_metadata"]
            name, type_name = str(told["name"]), str(told["type"])
            if told.get("serialization_format", "cdr") != "cdr":
                raise ValueError(f"{name} is not in CDR")
            if name in topics and topics[name].type_name != type_name:
                raise UserError(
                    f"{self.path}: {name} has two types in this bag, {topics[name].type_name} and "
                    f"{type_name}: record them under two names"
                )
            self.counts[name] += int(entry["message_count"])
            type_hash = str(told.get("type_description_hash") or "")
            qos = offered_profiles(told.get("offered_qos_profiles") or [])
            encoding, text = definitions.get(type_name, ("ros2msg", ""))
            topics[name] = BagTopic(name, type_name, text, type_hash, qos, encoding)
        return topics

    def _compare(self) -> None:
        there: Counter[str] = Counter()
        for file in self._files:
            there.update(file.counts())
        if +self.counts != +there or self.information["message_count"] != there.total():
            raise ValueError(
                f"{METADATA_FILE} tells of {self.counts.total()} messages, the data of "
                f"{there.total()}, or of others"
            )


def parsed_types(encoding: str, definition: str, type_name: str) -> dict[str, Any]:
    """Return the types that a schema's text defines; none for a text that is none."""
    found: dict[str, Any] = {}
    if encoding == "ros2msg":
        head, *others = _NEXT_TYPE.split(definition)
        found.update(_types_of_part(head, type_name))
        for other in others:
            name, _, text = other.partition("\n")
            found.update(_types_of_part(text, name))
        return found
    if encoding not in ("ros2idl", "omgidl"):
        return {}
    separator = "=" * 80 + "\n"
    parts = definition.split(separator)[1:] if definition.startswith(separator) else [definition]
    for part in parts:
        found.update(get_types_from_idl(part.partition("\n")[2] if len(parts) > 1 else part))
    return found


@functools.lru_cache(maxsize=_PARTS_KEPT)
def _types_of_part(text: str, type_name: str) -> dict[str, Any]:
    """Return the type that a part of a definition describes; nearly all have Header in them."""
    return dict(get_types_from_msg(text, type_name))


@functools.lru_cache(maxsize=_STORES_KEPT)
def _typestore(definitions: tuple[tuple[str, str, str, str], ...]) -> Typestore:
    """Return the types of definitions, each its encoding, text, type and hash."""
    if not definitions:
        return get_typestore(Stores.ROS2_JAZZY)
    store = get_typestore(Stores.EMPTY)
    for encoding, text, type_name, type_hash in definitions:
        # A text that is no definition, or another type's, makes its own messages unreadable.
        with contextlib.suppress(Exception):
            types = parsed_types(encoding, text, type_name)
            alone = get_typestore(Stores.EMPTY)
            alone.fielddefs.update(types)
            if type_hash in ("", alone.hash_rihs01(type_name)):
                # A class is made of each: not of Header twenty times.
                store.register({n: t for n, t in types.items() if store.fielddefs.get(n) != t})
    return store
