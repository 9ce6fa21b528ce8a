"""An arbiter of holds and its pages, in a time of their own."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from typing import Any

from needle_console.hold.hold_arbiter import HoldArbiter
from needle_console.hold.refusals import Refusal


def counting() -> Callable[[], str]:
    numbers = itertools.count()
    return lambda: f"n{next(numbers)}"


class Scene:
    """An arbiter and its pages, in a time of their own."""

    def __init__(self) -> None:
        self.arbiter = HoldArbiter(counting())
        self.now = 100.0
        self._sequences: dict[int, int] = {}

    def page(self) -> int:
        page = self.arbiter.open(self.now)
        assert page is not None
        self._sequences[page] = 0
        return page

    def message(self, page: int, pressed: bool, nonce: str | None = None, **changes: Any) -> str:
        if nonce is None:
            nonce = self.arbiter.issue(page, self.now)
            assert nonce is not None
        self._sequences[page] += 1
        fields = {
            "nonce": nonce,
            "sequence": self._sequences[page],
            "pressed": pressed,
            "speed": 0.5,
            "mode": "insert",
        }
        return json.dumps({**fields, **changes})

    def say(self, page: int, pressed: bool, **changes: Any) -> Refusal | None:
        return self.arbiter.receive(page, self.message(page, pressed, **changes), self.now)

    def press(self, page: int) -> None:
        assert self.say(page, False) is None
        assert self.say(page, True) is None
        assert self.pressed

    def wait(self, seconds: float) -> None:
        self.now += seconds

    @property
    def pressed(self) -> bool:
        return self.arbiter.state(self.now).pressed
