"""Bags as pandas data frames: a table for each topic, a row for each message."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from needle_bags.reading.bag_messages import IMAGE_TYPES, read_contents, read_messages
from needle_core.errors import UserError

if TYPE_CHECKING:
    import pandas as pd

INDEX, RECEIVED = "stamp", "received"
_HEALTH = "diagnostic_msgs/msg/DiagnosticArray"
_MAX_ELEMENTS = 64
_NAMES = ("name", "joint_names")


def read_frames(path: str | Path, topics: Collection[str] = ()) -> dict[str, pd.DataFrame]:
    """Return the topics of a bag as frames.

    A column is named after the path of its field, such as `pose.position.x`. Array elements are
    named by index, those of joints by joint (`position.insertion_joint`), and key-value pairs by
    key (`values.state`); the latter become numbers if the whole column is numeric. The index
    `stamp` is that of the header [s]: time of exposure or sampling on the rig's clock, common to
    all messages of an exposure. Without a header it is the time of reception, which every table
    has as the column `received` ([s], system clock).

    Parameters
    ----------
    path : str or Path
        A rosbag2 directory.
    topics : collection of str
        Topics to read; by default all except images.

    Returns
    -------
    dict of str to DataFrame
        Frames by topic name; `/diagnostics` has a row for each status.

    Raises
    ------
    UserError
        If pandas is not installed, there is no bag, it is incomplete, or it has no such topic.
    """
    try:
        # Optional dependency that takes a second to import.
        import pandas as pd  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise UserError("pandas is not installed: see docs/viewers.md") from error
    path = Path(path)
    types = {name: topic.type_name for name, topic in read_contents(path).topics.items()}
    for name in topics:
        if name not in types:
            raise UserError(f"{path}: no topic {name} (it has {', '.join(sorted(types))})")
    selected = topics or {name for name, kind in types.items() if kind not in IMAGE_TYPES}
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in sorted(selected)}
    for topic, log_time, message in read_messages(path, rows.__contains__):
        for row in _rows(message):
            rows[topic].append({INDEX: log_time * 1e-9, RECEIVED: log_time * 1e-9, **row})
    return {name: _frame(pd, found) for name, found in rows.items()}


def _rows(message: Any) -> Iterator[dict[str, Any]]:
    """Yield the rows of a message; the stamp of its header takes precedence."""
    if message.__msgtype__ == _HEALTH:
        for status in message.status:
            yield {**dict(_flat(message.header, ("header",))), **dict(_flat(status, ()))}
    else:
        yield flat_fields(message)


def flat_fields(message: Any) -> dict[str, Any]:
    """Return the fields of a rosbags message as the columns of `read_frames`."""
    return dict(_flat(message, ()))


def _flat(
    value: Any, parts: Sequence[str], joints: Sequence[str] = ()
) -> Iterator[tuple[str, Any]]:
    """Yield the columns of a field."""
    kind = getattr(value, "__msgtype__", "")
    if kind == "builtin_interfaces/msg/Time":
        stamp = value.sec + value.nanosec * 1e-9
        # Stamp of the header, or of a message that is a header itself.
        yield (INDEX if parts[:-1] in ((), ("header",)) else ".".join(parts)), stamp
    elif kind == "builtin_interfaces/msg/Duration":
        yield ".".join(parts), value.sec + value.nanosec * 1e-9
    elif kind:
        # Fields with a default are constants of the type.
        fields = {
            field.name: getattr(value, field.name)
            for field in dataclasses.fields(value)
            if field.default is dataclasses.MISSING
        }
        named = [fields.pop(name) for name in _NAMES if isinstance(fields.get(name), list)]
        for name, each in fields.items():
            yield from _flat(each, (*parts, name), named[0] if named else joints)
    elif isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        yield ".".join(parts), value
    elif not len(value):
        return
    elif getattr(value[0], "__msgtype__", "") == "diagnostic_msgs/msg/KeyValue":
        yield from ((".".join((*parts, pair.key)), pair.value) for pair in value)
    elif len(value) <= _MAX_ELEMENTS:
        are_joints = len(joints) == len(value) and not hasattr(value[0], "__msgtype__")
        for k, each in enumerate(value):
            name = joints[k] if are_joints else str(k)
            yield from _flat(each, (*parts, name), joints)


def _frame(pd: Any, rows: list[dict[str, Any]]) -> Any:
    frame = pd.DataFrame(rows, columns=None if rows else [INDEX, RECEIVED]).set_index(INDEX)
    for name in frame.columns:
        if name.startswith("values."):
            # Convert the column if all its values are numbers.
            numbers = pd.to_numeric(frame[name], errors="coerce")
            empty = frame[name].isna() | (frame[name] == "")
            if not empty.all() and (numbers.isna() == empty).all():
                frame[name] = numbers
    return frame
