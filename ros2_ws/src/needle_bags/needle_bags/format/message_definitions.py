"""Full definition texts of message types, from the installed .msg files."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_typestore

from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic, parsed_types
from needle_core.files.installed import find_shared_file

_SEPARATOR = "=" * 80
_SINGLE = (Nodetype.BASE, Nodetype.NAME)


def full_definition(type_name: str) -> str:
    """Return the definition of a type and all types it contains, in MCAP's format `ros2msg`.

    Parameters
    ----------
    type_name : str
        `package/msg/Name`.

    Raises
    ------
    UserError
        If the .msg file of the type, or of a contained type, is not installed.
    """
    texts: dict[str, str] = {}
    waiting = [type_name]
    while waiting:
        name = waiting.pop(0)
        if name in texts:
            continue
        texts[name] = _read(name)
        waiting += _contained(name, texts[name])
    parts: list[str] = []
    for name, text in texts.items():
        package, _, short = name.split("/")
        parts.append(text if not parts else f"{_SEPARATOR}\nMSG: {package}/{short}\n{text}")
    return "\n".join(part.rstrip("\n") for part in parts) + "\n"


def type_hash(type_name: str, definition: str) -> str:
    """Return the hash (`RIHS01_...`) of a full definition.

    Raises
    ------
    UserError
        If it cannot be parsed.
    """
    store = get_typestore(Stores.EMPTY)
    try:
        store.fielddefs.update(parsed_types("ros2msg", definition, type_name))
        return store.hash_rihs01(type_name)
    except (TypesysError, KeyError) as error:
        raise UserError(f"the definition of {type_name} cannot be read: {error}") from error


def message_class(type_name: str) -> Any:
    """Return the class of an installed message or service type.

    Raises
    ------
    ImportError, AttributeError, ValueError
        If it is not installed, or the name is invalid.
    """
    package, kind, short = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), short)


def unplayable(topic: BagTopic) -> str:
    """Return the reason why a topic cannot be played; empty if it can."""
    try:
        installed = full_definition(topic.type_name)
        message_class(topic.type_name)
        installed_hash = type_hash(topic.type_name, installed)
        recorded_hash = topic.type_hash or (
            type_hash(topic.type_name, topic.definition) if topic.definition else installed_hash
        )
    except UserError as error:
        return str(error)
    except (ImportError, AttributeError, ValueError):
        return f"{topic.type_name} is not installed"
    if installed_hash != recorded_hash:
        return (
            f"{topic.type_name} has another definition in this bag than here (another "
            "ROS distribution): play it where it was recorded"
        )
    return ""


def _read(type_name: str) -> str:
    try:
        package, kind, name = type_name.split("/")
        return find_shared_file(package, f"{kind}/{name}.msg").read_text(encoding="utf-8")
    except ValueError:
        raise UserError(f"{type_name!r} is not a message type: use package/msg/Name") from None
    except UserError:
        why = f"the definition of {type_name} is not installed (AMENT_PREFIX_PATH)"
        raise UserError(why) from None


def _contained(type_name: str, text: str) -> Iterator[str]:
    """Yield the full names of the message types in a definition."""
    _, fields = parsed_types("ros2msg", text, type_name)[type_name]
    for _, (kind, detail) in fields:
        # An array or sequence is described by its element and its length.
        element, name = (kind, detail) if kind in _SINGLE else detail[0]
        if element == Nodetype.NAME:
            yield name
