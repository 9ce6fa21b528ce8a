"""An arbiter of holds and its pages, in a time of their own."""

from __future__ import annotations

import json
from typing import Any

from needle_console.hold.hold_arbiter import HoldArbiter
from needle_console.hold.refusals import Refusal


class Scene:
    """An arbiter and its pages, in a time of their own.

    `bars` says why a page may not hold, by whether it is on the rig's machine.
    """

    def __init__(self) -> None:
        self.bars = {True: "", False: ""}
        self.arbiter = HoldArbiter(lambda is_local: self.bars[is_local])
        self.now = 100.0

    def page(self, *, is_local: bool = True) -> int:
        return self.arbiter.open(self.now, is_local=is_local)

    def count(self, page: int) -> int:
        """Send a page a count now."""
        return int(str(self.arbiter.tell(page, self.now)["count"]))

    def message(self, page: int, pressed: bool, count: int | None = None, **changes: Any) -> str:
        count = self.count(page) if count is None else count
        fields = {"count": count, "pressed": pressed, "speed": 0.5, "mode": "insert"}
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
