"""Messages of a page: anything outside the protocol is a ValueError."""

from __future__ import annotations

import json
from typing import Any

import pytest

from needle_console.hold.page_session import Mode, PageHold, read_message

GOOD: dict[str, Any] = {"count": 3, "pressed": True, "speed": 0.5, "mode": "retract"}
WRONG: dict[str, list[Any]] = {
    "count": [True, 1.0],
    "pressed": [1],
    "speed": [float("nan"), -0.01, 1.01, True],
    "mode": ["home", ["insert"], None],
    "more": [1],
}
NO_OBJECTS: tuple[str | bytes, ...] = ("", "{", "[]", json.dumps(GOOD) + "x", b"\xff\xfe")


def test_valid_message_is_read() -> None:
    assert read_message(json.dumps(GOOD)) == (3, PageHold(True, 0.5, Mode.RETRACT))
    for speed in (0, 1):
        assert read_message(json.dumps({**GOOD, "speed": speed}))[1].speed == float(speed)


def test_anything_else_is_refused() -> None:
    fields = [{**GOOD, key: value} for key, values in WRONG.items() for value in values]
    fields += [{name: GOOD[name] for name in GOOD if name != key} for key in GOOD]
    for data in (*map(json.dumps, fields), *NO_OBJECTS):
        with pytest.raises(ValueError):
            read_message(data)
