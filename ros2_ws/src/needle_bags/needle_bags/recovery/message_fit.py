"""Fit of bytes to their topic's type: what vouches for a message where there is no checksum."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping

from mcap.records import Channel, Schema
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from needle_common.files.bag_data import is_packed, unpack
from needle_common.files.bag_directory import parsed_types

_TYPE_HASH = "topic_type_hash"
_JAZZY = get_typestore(Stores.ROS2_JAZZY)


class MessageFit:
    """Looks at messages by the definitions that a file has.

    Parameters
    ----------
    schemas, channels : mapping
        By number; they may grow (`forget`).
    distrusted : collection of int
        Channels whose definition is known to be wrong.
    """

    def __init__(
        self,
        schemas: Mapping[int, Schema],
        channels: Mapping[int, Channel],
        distrusted: Collection[int] = (),
    ) -> None:
        self._distrusted = distrusted
        self._schemas = schemas
        self._channels = channels
        self._stores: dict[int, tuple[str, Typestore] | None] = {}

    def forget(self) -> None:
        """Take note that there are other definitions."""
        self._stores.clear()

    def knows(self, channel: int) -> bool:
        """Return whether messages of a channel can be looked at."""
        return self._store(channel) is not None

    def fits(self, channel: int, data: bytes) -> bool:
        """Return whether a message is of its channel's type; True where the type is not known."""
        found = self._store(channel)
        if found is None:
            return True
        name, store = found
        try:
            store.deserialize_cdr(unpack(data) if is_packed(data) else data, name)
        # whatever rosbags' generated code meets in bytes of another type
        except Exception:  # noqa: BLE001
            return False
        return True

    def _store(self, number: int) -> tuple[str, Typestore] | None:
        if number not in self._stores:
            self._stores[number] = None
            channel = self._channels.get(number)
            schema = self._schemas.get(channel.schema_id) if channel is not None else None
            if channel is not None and schema is not None and number not in self._distrusted:
                mended = mended_schema(schema, channel)
                store = _typestore(mended)
                if store is not None and _is_told(mended, store, channel):
                    self._stores[number] = (mended.name, store)
        return self._stores[number]


def mended_schema(schema: Schema, channel: Channel) -> Schema:
    """Return the schema, with ROS 2 Jazzy's text if its own is not what the channel's hash says."""
    store = _typestore(schema)
    if store is not None and _is_told(schema, store, channel):
        return schema
    told = channel.metadata.get(_TYPE_HASH)
    if told and schema.name in _JAZZY.types and _is_told(schema, _JAZZY, channel):
        text, _ = _JAZZY.generate_msgdef(schema.name, ros_version=2)
        return dataclasses.replace(schema, encoding="ros2msg", data=text.encode())
    return schema


def type_hash(schema: Schema) -> str:
    """Return a type's hash by its definition; an empty text if that is none."""
    store = _typestore(schema)
    return "" if store is None else str(store.hash_rihs01(schema.name))


def _is_told(schema: Schema, store: Typestore, channel: Channel) -> bool:
    told = channel.metadata.get(_TYPE_HASH, "")
    return not told or store.hash_rihs01(schema.name) == told


def _typestore(schema: Schema) -> Typestore | None:
    try:
        types = parsed_types(schema.encoding, schema.data.decode(), schema.name)
        if schema.name not in types:
            return None
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        store.hash_rihs01(schema.name)
    # a text that is no definition
    except Exception:  # noqa: BLE001
        return None
    return store
