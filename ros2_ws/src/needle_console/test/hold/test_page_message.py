"""Messages of a page: anything outside the protocol is a ValueError."""

from __future__ import annotations

import json
from typing import Any

import pytest

from needle_console.hold.page_session import Mode, PageHold, read_message

GOOD: dict[str, Any] = {"count": 3, "pressed": True, "speed": 0.5, "mode": "retract"}
WRONG: dict[str, list[Any]] = {
    "count": [True, 1.0, "1", None],
    "pressed": [1, "true", None],
    "speed": [float("nan"), float("inf"), -0.01, 1.01, True, "1", None],
    "mode": ["home", ["insert"], None],
    "more": [1],
}
NO_OBJECTS = ["", "{", "[]", "1", "null", json.dumps(GOOD) + "x", "[" * 100_000, b"\0", b"\xff\xfe"]


def test_valid_message_is_read() -> None:
    assert read_message(json.dumps(GOOD)) == (3, PageHold(True, 0.5, Mode.RETRACT))
    for speed in (0, 1):
        assert read_message(json.dumps({**GOOD, "speed": speed}))[1].speed == float(speed)


@pytest.mark.parametrize("key", WRONG)
def test_invalid_extra_or_missing_field_is_refused(key: str) -> None:
    for value in WRONG[key]:
        with pytest.raises(ValueError):
            read_message(json.dumps({**GOOD, key: value}))
    if key in GOOD:
        with pytest.raises(ValueError):
            read_message(json.dumps({name: value for name, value in GOOD.items() if name != key}))


@pytest.mark.parametrize("data", NO_OBJECTS, ids=range(len(NO_OBJECTS)))
def test_other_data_than_a_json_object_is_refused(data: str | bytes) -> None:
    with pytest.raises(ValueError):
        read_message(data)
