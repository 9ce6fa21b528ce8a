"""Messages to pages, and the reports of the hold."""

from __future__ import annotations

import json
from typing import Any

import pytest

from needle_console.hold.hold_protocol import IDLE_PERIOD, PERIOD, SILENCE, HoldProtocol
from needle_console.hold.page_session import ECHO_AGE_LIMIT, RELEASED, PageHold


class Scene:
    """A protocol with one page and virtual time."""

    def __init__(self) -> None:
        self.states: list[PageHold] = []
        self.notices: list[str] = []
        self.protocol = HoldProtocol(lambda _: "", self.states.append, self.notices.append, 0.0)

    def come(self, now: float) -> None:
        self.page = self.protocol.open(now, is_local=True)

    def message_to(self, now: float) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.protocol.message_for(self.page, now))
        return told

    def say(self, pressed: bool, now: float) -> None:
        count = self.message_to(now)["count"]
        message = {"count": count, "pressed": pressed, "speed": 0.5, "mode": "insert"}
        self.protocol.receive(self.page, json.dumps(message), now)

    def look_until(self, now: float, end: float) -> float:
        """Update at the requested times; return the time of the next update."""
        while now < end:
            now = self.protocol.update(now)
        return now


@pytest.mark.parametrize("first", ["word", "message", "look"])
def test_page_gets_the_reason_after_a_stall(first: str) -> None:
    scene = Scene()
    scene.come(0.0)
    scene.say(False, 1.0)
    scene.say(True, 1.0)
    assert scene.states[-1].pressed
    now = 1.0 + ECHO_AGE_LIMIT + 0.5
    if first == "message":
        scene.say(True, now)
    elif first == "look":
        scene.protocol.update(now)
    told = scene.message_to(now)
    assert not told["held"]
    assert told["why"].startswith("no echo from this page for 0.25 s")
    assert scene.protocol.counts()["hold lost"] == 1
    scene.protocol.update(now)
    assert not scene.states[-1].pressed


def test_hold_is_reported_every_20_ms_or_80_ms_without_a_page() -> None:
    scene = Scene()
    now = scene.look_until(0.0, 1.0)
    assert set(scene.states) == {RELEASED}
    assert len(scene.states) == pytest.approx(1.0 / IDLE_PERIOD, abs=1)
    # The first page shortens the period at once.
    now += 0.1 * PERIOD - IDLE_PERIOD
    scene.come(now)
    assert scene.protocol.update(now) <= now + PERIOD
    scene.states.clear()
    scene.look_until(now, now + 1.0)
    assert len(scene.states) == pytest.approx(1.0 / PERIOD, abs=1)


def test_changes_of_the_hold_are_reported_at_once() -> None:
    scene = Scene()
    scene.come(0.0)
    for end in ("silence", "close"):
        begin = scene.look_until(0.0, 1.0) if end == "silence" else 2.0
        scene.say(False, begin)
        scene.say(True, begin)
        assert scene.states[-1] == PageHold(True, 0.5, scene.states[-1].mode)
        if end == "close":
            scene.protocol.close(scene.page, begin)
        else:
            scene.look_until(begin, begin + ECHO_AGE_LIMIT)
            assert scene.states[-1].pressed
            now = scene.look_until(begin, begin + ECHO_AGE_LIMIT + 1e-9)
            assert now <= begin + ECHO_AGE_LIMIT + 1e-3
            scene.protocol.update(now)
        assert scene.states[-1] == RELEASED


def test_refusals_are_counted_and_logged_once() -> None:
    scene = Scene()
    scene.come(0.0)
    for _ in range(3):
        scene.protocol.receive(scene.page, "{", 0.0)
    assert not scene.protocol.is_silent(scene.page, SILENCE)
    assert scene.protocol.is_silent(scene.page, SILENCE + 1.0)
    assert scene.protocol.counts() == {"invalid message": 3, "silent page": 1}
    assert scene.notices == ["hold: invalid message", "hold: silent page"]
