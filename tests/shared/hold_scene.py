"""Pages and their hold protocol, in virtual time."""

from __future__ import annotations

import json
from typing import Any

from needle_console.hold.hold_protocol import HoldProtocol
from needle_console.hold.page_session import HoldRefusal, PageHold


class Scene:
    """A hold protocol and its pages, in virtual time.

    `bars` gives the reason why a page may not hold, by whether it is local.
    """

    def __init__(self) -> None:
        self.bars = {True: "", False: ""}
        self.now = 100.0
        self.reported: list[PageHold] = []
        self.notices: list[str] = []
        self.protocol = HoldProtocol(
            self.bars.__getitem__, self.reported.append, self.notices.append, self.now
        )

    def page(self, *, is_local: bool = True) -> int:
        return self.protocol.open(self.now, is_local=is_local)

    def message_to(self, page: int) -> dict[str, Any]:
        """Send a page a message now; return it."""
        message: dict[str, Any] = json.loads(self.protocol.message_for(page, self.now))
        return message

    def count(self, page: int) -> int:
        """Send a page a count now."""
        return int(self.message_to(page)["count"])

    def message(self, page: int, pressed: bool, count: int | None = None, **changes: Any) -> str:
        count = self.count(page) if count is None else count
        fields = {"count": count, "pressed": pressed, "speed": 0.5, "mode": "insert"}
        return json.dumps({**fields, **changes})

    def send(self, page: int, pressed: bool, **changes: Any) -> HoldRefusal | None:
        return self.protocol.receive(page, self.message(page, pressed, **changes), self.now)

    def press(self, page: int) -> None:
        assert self.send(page, False) is None
        assert self.send(page, True) is None
        assert self.pressed

    def wait(self, seconds: float) -> None:
        self.now += seconds

    @property
    def pressed(self) -> bool:
        return self.protocol.state(self.now).pressed
