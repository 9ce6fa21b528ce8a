"""Random messages of any type, valid and extreme, as from a faulty publisher."""

from __future__ import annotations

import math
import random
import re
from typing import Any

from needle_bags.format.message_definitions import message_class

_BITS = {"int8": 8, "int16": 16, "int32": 32, "int64": 64}
_TEXTS = ("", "rig", "insertion_joint", "rotation_joint", "tip", "STEERING", "nan", "-1", "\0")
_SPECIAL = (0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 1e-320, 1e300, -1e30, 1e-3)
_LONGEST = 40
_SEQUENCE = re.compile(r"sequence<(.*?)(?:, (\d+))?>$")
_ARRAY = re.compile(r"(.*)\[(\d+)\]$")


def random_message(kind: Any, rng: random.Random) -> Any:
    """Return a message with random fields, some of them extreme."""
    message = kind()
    for name, type_name in kind.get_fields_and_field_types().items():
        setattr(message, name, _value(type_name, rng))
    return message


def _value(type_name: str, rng: random.Random) -> Any:
    sequence, array = _SEQUENCE.match(type_name), _ARRAY.match(type_name)
    if sequence:
        most = min(int(sequence[2] or _LONGEST), _LONGEST)
        return _values(sequence[1], rng.choice((0, 1, 2, rng.randrange(most + 1))), rng)
    if array:
        return _values(array[1], int(array[2]), rng)
    if type_name == "boolean":
        return rng.random() < 0.5
    if type_name in ("octet", "byte"):
        return bytes([rng.randrange(256)])
    if type_name in ("float", "double"):
        number = rng.choice((rng.choice(_SPECIAL), rng.uniform(-1.0, 1.0)))
        # A value beyond float32 is not valid.
        return number if type_name == "double" or not 3e38 < abs(number) < math.inf else 3e38
    if type_name.startswith("string") or type_name.startswith("wstring"):
        return rng.choice((*_TEXTS, "x" * rng.randrange(3000)))
    bits = _BITS.get(type_name.removeprefix("u"))
    if bits:
        low, high = (0, 2**bits) if type_name[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1))
        return rng.choice(
            (low, high - 1, min(1, high), rng.randrange(low, high), rng.randrange(16))
        )
    package, short = type_name.split("/")
    return random_message(message_class(f"{package}/msg/{short}"), rng)


def _values(type_name: str, count: int, rng: random.Random) -> list[Any]:
    return [_value(type_name, rng) for _ in range(count)]
