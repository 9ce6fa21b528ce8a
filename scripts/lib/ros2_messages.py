"""Messages as text, as ROS 2's own command line writes and reads them: YAML."""

from __future__ import annotations

import array
import importlib
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import yaml

TRUNCATED = "..."
# How many elements of an array, and characters of a text, are written.
LONGEST = 128
# of `sequence<geometry_msgs/Point, 4>` and `geometry_msgs/Point[4]`
ELEMENT = re.compile(r"\w+/\w+")
# Sets one time field, or one header's stamp, to the time that it is given.
StampSetter = Callable[[Any], None]


class BadMessageError(ValueError):
    """A type that does not exist, or values that do not fit it."""


def find_type(name: str, kind: str) -> Any:
    """Return an interface's class.

    Parameters
    ----------
    name : str
        `sensor_msgs/msg/Joy`, or `sensor_msgs/Joy`.
    kind : str
        `msg` or `srv`.

    Raises
    ------
    BadMessageError
        If this environment has no such type.
    """
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    word = {"msg": "message", "srv": "service"}[kind]
    try:
        package, folder, type_name = parts
        found = getattr(importlib.import_module(f"{package}.{folder}"), type_name)
    except (AttributeError, ModuleNotFoundError, ValueError) as error:
        raise BadMessageError(f"The passed {word} type is invalid") from error
    if folder != kind:
        raise BadMessageError(f"The passed type is not a {word}")
    return found


def to_yaml(value: Any) -> str:
    """Return a message, or a field of one, as YAML; what is long is shortened."""
    return str(yaml.safe_dump(_plain(value), allow_unicode=True, width=1 << 30, sort_keys=False))


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, str):
        return value if len(value) <= LONGEST else value[:LONGEST] + TRUNCATED
    if isinstance(value, (bool, int, float)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, (list, tuple, array.array, np.ndarray)):
        items = [_plain(item) for item in value[:LONGEST]]
        return items + [TRUNCATED] * (len(value) > len(items))
    return {name: _plain(getattr(value, name)) for name in value.get_fields_and_field_types()}


def parse(text: str) -> Mapping[str, Any]:
    """Return the values that a command line gives.

    Raises
    ------
    BadMessageError
        If the text is no YAML mapping.
    """
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise BadMessageError(f"not YAML: {' '.join(str(error).split())}") from error
    if not isinstance(values, Mapping):
        raise BadMessageError("The passed value needs to be a dictionary in YAML format")
    return values


def fill(message: Any, values: Mapping[str, Any]) -> list[StampSetter]:
    """Set a message's fields.

    Parameters
    ----------
    message : message
        What to fill.
    values : mapping
        Field name to value, nested as the message is. `now` stands for the time at which a
        message is sent, `auto` for a header with that time.

    Returns
    -------
    list of callable
        Each sets one of the times that were given as `now` or `auto`.

    Raises
    ------
    BadMessageError
        If a field does not exist or a value does not fit it.
    """
    setters: list[StampSetter] = []
    if not isinstance(values, Mapping):
        raise BadMessageError(f"'{values}' is expected to be a dictionary")
    types = message.get_fields_and_field_types()
    for name, value in values.items():
        if name not in types:
            raise BadMessageError(f"'{type(message).__name__}' has no field '{name}'")
        field = getattr(message, name)
        if types[name] == "builtin_interfaces/Time" and value == "now":
            setters.append(_setter(message, name))
        elif types[name] == "std_msgs/Header" and value == "auto":
            setters.append(_setter(field, "stamp"))
        elif hasattr(field, "get_fields_and_field_types"):
            setters += fill(field, value)
        else:
            _set(message, name, _value(types[name], field, value, setters))
    return setters


def _setter(message: Any, name: str) -> StampSetter:
    return lambda stamp: setattr(message, name, stamp)


def _set(message: Any, name: str, value: Any) -> None:
    try:
        setattr(message, name, value)
    except (AssertionError, TypeError, ValueError, OverflowError) as error:
        text = " ".join(str(error).split())
        raise BadMessageError(f"'{name}' cannot be {value!r}: {text}") from error


def _value(type_name: str, field: Any, value: Any, setters: list[StampSetter]) -> Any:
    """Return a value in the type that the field wants."""
    try:
        if isinstance(field, array.array):
            return array.array(field.typecode, value)
        if isinstance(field, np.ndarray):
            return np.array(value, dtype=field.dtype)
        if isinstance(field, list) and "/" in type_name:
            element = find_type(ELEMENT.findall(type_name)[0], "msg")
            messages = [element() for _ in value]
            for message, entry in zip(messages, value, strict=True):
                setters += fill(message, entry)
            return messages
        # a text for a number or a flag is more likely a slip than a wish
        if isinstance(field, float) and isinstance(value, int) and not isinstance(value, bool):
            return float(value)
        if isinstance(field, bytes) and isinstance(value, int):
            return bytes([value])
    except BadMessageError:
        raise
    except (TypeError, ValueError, OverflowError) as error:
        raise BadMessageError(f"{value!r} is no {type_name}: {error}") from error
    return value
