"""Topics of a bag: quality of service, and message types from the definitions in the bag."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from rosbags.interfaces import Qos, QosDurability, QosTime
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from needle_core.files.yaml_files import load_yaml


def offered_profiles(profiles: Sequence[Mapping[str, Any]] | str) -> tuple[Qos, ...]:
    """Return the QoS profiles of metadata.yaml or an MCAP channel; none if they are malformed.

    Parameters
    ----------
    profiles : sequence of mapping or str
        A list (from version 9 on), or its YAML text.
    """
    try:
        found: Any = load_yaml(profiles) or [] if isinstance(profiles, str) else profiles
        return tuple(
            qos._replace(
                depth=int(qos.depth),
                deadline=QosTime(*map(int, qos.deadline)),
                lifespan=QosTime(*map(int, qos.lifespan)),
                liveliness_lease_duration=QosTime(*map(int, qos.liveliness_lease_duration)),
            )
            for qos in parse_qos(found)
        )
    except (ValueError, TypeError, KeyError, AttributeError):
        return ()


@dataclasses.dataclass(frozen=True)
class BagTopic:
    """Topic of a bag.

    Attributes
    ----------
    name : str
        Absolute name.
    type_name : str
        `package/msg/Name`.
    definition : str
        Full definition of the type; empty if the bag has none.
    type_hash : str
        `RIHS01_...` as announced by the publishers, or empty.
    offered_qos : tuple of Qos
        QoS of each publisher.
    encoding : str
        Encoding of the definition: `ros2msg` or `ros2idl`.
    """

    name: str
    type_name: str
    definition: str
    type_hash: str = ""
    offered_qos: tuple[Qos, ...] = ()
    encoding: str = "ros2msg"

    @property
    def is_latched(self) -> bool:
        """Whether late subscribers receive a publisher's last messages."""
        return any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in self.offered_qos)


# Sizes of the caches: parsing a rig's definitions takes 0.2 s, and a bag is read several times.
_STORES_KEPT: Final = 4
_PARTS_KEPT: Final = 256
_NEXT_TYPE: Final = re.compile(r"^={80}\nMSG: ", re.MULTILINE)


def parsed_types(encoding: str, definition: str, type_name: str) -> dict[str, Any]:
    """Return the types that a schema defines; none for another encoding than `ros2msg`."""
    if encoding != "ros2msg":
        return {}
    head, *others = _NEXT_TYPE.split(definition)
    found = dict(_types_of_part(head, type_name))
    for other in others:
        name, _, text = other.partition("\n")
        found.update(_types_of_part(text, name))
    return found


@functools.lru_cache(maxsize=_PARTS_KEPT)
def _types_of_part(text: str, type_name: str) -> dict[str, Any]:
    """Return the type of one part of a definition; cached, as nearly all contain Header."""
    return dict(get_types_from_msg(text, type_name))


@functools.lru_cache(maxsize=_STORES_KEPT)
def typestore_of(definitions: tuple[tuple[str, str, str, str], ...]) -> Typestore:
    """Return the type store of definitions, each given as encoding, text, type and hash."""
    if not definitions:
        return get_typestore(Stores.ROS2_JAZZY)
    store = get_typestore(Stores.EMPTY)
    for encoding, text, type_name, type_hash in definitions:
        # A malformed definition makes only its own messages unreadable.
        with contextlib.suppress(Exception):
            types = parsed_types(encoding, text, type_name)
            alone = get_typestore(Stores.EMPTY)
            alone.fielddefs.update(types)
            if type_hash in ("", alone.hash_rihs01(type_name)):
                # Registering creates a class, so skip types that are known.
                store.register({n: t for n, t in types.items() if store.fielddefs.get(n) != t})
    return store
