"""What a page may say."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from needle_console.hold.hold_state import Mode
from needle_console.hold.page_message import GarbageError, PageMessage, read_message

GOOD: dict[str, Any] = {
    "count": 3,
    "pressed": True,
    "speed": 0.5,
    "mode": "retract",
}


def test_a_message_is_read() -> None:
    expected = PageMessage(3, True, 0.5, Mode.RETRACT)
    assert read_message(json.dumps(GOOD)) == expected
    assert read_message(json.dumps({**GOOD, "speed": 1})).speed == 1.0


@pytest.mark.parametrize(
    "change",
    [
        {"count": True},
        {"count": 1.0},
        {"count": "1"},
        {"pressed": 1},
        {"pressed": "true"},
        {"pressed": None},
        {"speed": float("nan")},
        {"speed": float("inf")},
        {"speed": -0.01},
        {"speed": 1.01},
        {"speed": True},
        {"speed": "1"},
        {"speed": None},
        {"mode": "home"},
        {"mode": ["insert"]},
        {"more": 1},
    ],
)
def test_what_is_not_as_agreed_is_garbage(change: dict[str, Any]) -> None:
    with pytest.raises(GarbageError):
        read_message(json.dumps({**GOOD, **change}))


@pytest.mark.parametrize("key", GOOD)
def test_nothing_may_be_missing(key: str) -> None:
    with pytest.raises(GarbageError):
        read_message(json.dumps({name: value for name, value in GOOD.items() if name != key}))


@pytest.mark.parametrize(
    "data",
    [
        "",
        "{",
        "[]",
        "1",
        "null",
        json.dumps(GOOD) + "x",
        '{"count": 3, "pressed": true, "speed": 1e999, "mode": "insert"}',
        "[" * 100_000,
    ],
)
def test_what_is_no_json_object_is_garbage(data: str | bytes) -> None:
    with pytest.raises(GarbageError):
        read_message(data)


@given(st.one_of(st.text(), st.binary()))
def test_nothing_else_is_raised(data: str | bytes) -> None:
    with pytest.raises(GarbageError):
        read_message(data)
