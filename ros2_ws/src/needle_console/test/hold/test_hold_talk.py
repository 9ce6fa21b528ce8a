"""What pages are told of their hold, whatever is done first after a stall."""

from __future__ import annotations

import json
from typing import Any

import pytest

from needle_console.hold.hold_state import HoldState
from needle_console.hold.hold_talk import HoldTalk
from needle_console.hold.page_session import ECHO_AGE_LIMIT


class Scene:
    """A talk with one page, in a time of its own."""

    def __init__(self) -> None:
        self.states: list[HoldState] = []
        self.talk = HoldTalk(lambda _: "", self.states.append, lambda _: None, 0.0)
        self.page = self.talk.open(0.0, is_local=True)

    def told(self, now: float) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self.talk.word_for(self.page, now))
        return told

    def say(self, pressed: bool, now: float) -> None:
        count = self.told(now)["count"]
        message = {"count": count, "pressed": pressed, "speed": 0.5, "mode": "insert"}
        self.talk.hear(self.page, json.dumps(message), now)


@pytest.mark.parametrize("first", ["word", "message", "look"])
def test_after_a_stall_the_page_is_told_why_its_hold_has_ended(first: str) -> None:
    scene = Scene()
    scene.say(False, 1.0)
    scene.say(True, 1.0)
    assert scene.states[-1].pressed
    now = 1.0 + ECHO_AGE_LIMIT + 0.5
    if first == "message":
        scene.say(True, now)
    elif first == "look":
        scene.talk.look(now)
    told = scene.told(now)
    assert not told["held"]
    assert told["why"].startswith("no echo from this page for 0.25 s")
    assert scene.talk.refusals.counts()["hold lost"] == 1
    scene.talk.look(now)
    assert not scene.states[-1].pressed
