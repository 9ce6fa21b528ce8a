"""Opens any rosbag2 directory; what cannot be opened is one line that says what to do."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, cast

import yaml
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, Qos
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from needle_bringup.bag_metadata import METADATA_FILE, BagTopic, OfferedQos
from needle_common.errors import UserError

_NANOSECONDS = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class BagContents:
    """What a bag says about itself.

    Attributes
    ----------
    path : Path
        The bag's directory.
    topics : dict of str to BagTopic
        By name.
    counts : dict of str to int
        Messages for each topic.
    start, end : int
        Log times of the first and the last message, system clock [ns]; 0 in an empty bag.
    custom_data : dict of str to str
        What the recorder left in metadata.yaml.
    distribution : str
        ROS distribution it was recorded with; empty where not known.
    """

    path: Path
    topics: dict[str, BagTopic]
    counts: dict[str, int]
    start: int
    end: int
    custom_data: dict[str, str]
    distribution: str


def recover_hint(path: Path) -> str:
    """Return what to type for a bag that is not whole."""
    return f"run `ros2 run needle_bringup recover {path}`"


def read_contents(path: Path) -> BagContents:
    """Return what a bag says about itself.

    Parameters
    ----------
    path : Path
        A rosbag2 directory, MCAP or SQLite.

    Raises
    ------
    UserError
        If there is no bag, or it is not whole.
    """
    require_bag(path)
    with readable(path), Reader(path) as reader:
        topics: dict[str, BagTopic] = {}
        counts: dict[str, int] = {}
        for connection in reader.connections:
            name = connection.topic
            if name in topics and topics[name].type_name != connection.msgtype:
                raise UserError(
                    f"{path}: {name} has two types in this bag, {topics[name].type_name} and "
                    f"{connection.msgtype}: record them under two names"
                )
            topics[name] = _topic(connection)
            counts[name] = counts.get(name, 0) + connection.msgcount
        text = (path / METADATA_FILE).read_text(encoding="utf-8")
        information = yaml.safe_load(text)["rosbag2_bagfile_information"]
        custom = information.get("custom_data") or {}
        empty = not reader.message_count
        return BagContents(
            path,
            topics,
            counts,
            0 if empty else reader.start_time,
            0 if empty else reader.end_time - 1,
            {str(key): str(value) for key, value in custom.items()},
            str(information.get("ros_distro") or ""),
        )


def read_messages(path: Path, wanted: Callable[[str], bool]) -> Iterator[tuple[str, int, Any]]:
    """Yield (topic, log time [ns], message) in order of log time, of the topics that are wanted.

    Messages are read by the definitions that the bag carries.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    require_bag(path)
    store = get_typestore(Stores.ROS2_JAZZY)
    with readable(path), AnyReader([path], default_typestore=store) as reader:
        connections = [c for c in reader.connections if wanted(c.topic)]
        if not connections:
            return
        for connection, log_time, data in reader.messages(connections=connections):
            with readable(path):
                message = reader.deserialize(data, connection.msgtype)
            yield connection.topic, log_time, message


def raw_messages(
    path: Path, topics: Collection[str], start: int, stop: int
) -> Iterator[tuple[str, int, bytes]]:
    """Yield (topic, log time [ns], serialised message) with start <= log time < stop, in order.

    Raises
    ------
    UserError
        If the bag cannot be read.
    """
    require_bag(path)
    with readable(path), Reader(path) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        if connections:
            for connection, log_time, data in reader.messages(connections, start, stop):
                yield connection.topic, log_time, bytes(data)


def require_bag(path: Path) -> None:
    """Raise a `UserError` if a path is no bag with metadata.yaml."""
    if path.is_file():
        raise UserError(f"{path} is a file: name the bag's directory, {path.absolute().parent}")
    if not path.is_dir():
        raise UserError(f"{path}: no such bag directory")
    if (path / METADATA_FILE).is_file():
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
        with file.open("rb") as stream:
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
        reason = lines[0].rstrip(".") if lines else type(error).__name__
        if isinstance(error, OSError):
            reason = error.strerror or reason
        raise UserError(f"{path}: the bag is broken ({reason}): {recover_hint(path)}") from error


def _topic(connection: Connection) -> BagTopic:
    profiles = cast(ConnectionExtRosbag2, connection.ext).offered_qos_profiles
    return BagTopic(
        connection.topic,
        connection.msgtype,
        connection.msgdef.data,
        connection.digest,
        tuple(_offered(profile) for profile in profiles),
    )


def _offered(qos: Qos) -> OfferedQos:
    return OfferedQos(
        history=qos.history.name.lower(),
        depth=qos.depth,
        reliability=qos.reliability.name.lower(),
        durability=qos.durability.name.lower(),
        deadline=qos.deadline.sec * _NANOSECONDS + qos.deadline.nsec,
        lifespan=qos.lifespan.sec * _NANOSECONDS + qos.lifespan.nsec,
        liveliness=qos.liveliness.name.lower(),
        lease_duration=qos.liveliness_lease_duration.sec * _NANOSECONDS
        + qos.liveliness_lease_duration.nsec,
    )
