"""All pages and the one hold: who has it, and what it comes to."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.hold.page_message import GarbageError, read_message
from needle_console.hold.page_session import ECHO_AGE_LIMIT, PageSession
from needle_console.hold.refusals import Refusal

SILENCE = 5.0
"""A page that says nothing for so long is gone [s]."""

IDLE = 30.0
"""An owner that has not pressed for so long lets another page have the hold [s]."""

OTHER_PAGE = "another page steers"
_STALLED = f"no echo from this page for {ECHO_AGE_LIMIT:g} s (browser, network or console stalled)"


@dataclasses.dataclass
class _Page:
    session: PageSession
    is_local: bool
    # Why its last press did not count, or no longer does; empty: it does, or was let go.
    why: str = ""


class HoldArbiter:
    """Takes what pages say. `now` is everywhere the steady clock [s].

    The first page that presses owns the hold, until it is gone or has not pressed for `IDLE`: what
    two people want who see two pages is not decided by who presses in the other's pause.

    Parameters
    ----------
    why_not : callable
        Returns why a page may only watch, empty if it may hold; takes whether it is shown on the
        rig's own machine.
    """

    def __init__(self, why_not: Callable[[bool], str]) -> None:
        self._why_not = why_not
        # Of all that is sent to pages: so no count is sent on two connections.
        self._count = 0
        self._pages: dict[int, _Page] = {}
        self._last_page = 0
        self._owner: int | None = None
        self._held_at = -math.inf

    @property
    def has_pages(self) -> bool:
        """Whether anybody is there who could press."""
        return bool(self._pages)

    @property
    def until(self) -> float:
        """Time at which the hold ends unless more comes [s]; minus infinity without one."""
        return -math.inf if self._owner is None else self._pages[self._owner].session.until

    def open(self, now: float, *, is_local: bool) -> int:
        """Let a page in; return its number."""
        self._last_page += 1
        self._pages[self._last_page] = _Page(PageSession(now), is_local)
        return self._last_page

    def close(self, page: int) -> None:
        """Let a page go, and its hold with it."""
        del self._pages[page]
        if self._owner == page:
            self._owner = None

    def receive(self, page: int, data: str | bytes, now: float) -> Refusal | None:
        """Take a page's message; return why it does not count. Garbage ends the page's hold."""
        entry = self._pages[page]
        try:
            message = read_message(data)
        except GarbageError:
            entry.session.end()
            return Refusal.GARBAGE
        bar = self._bar(page, now)
        refusal = entry.session.receive(message, now, free=not bar)
        counts = entry.session.state(now).pressed
        if counts:
            self._owner = page
            self._held_at = now
        if counts or not message.pressed:
            entry.why = ""
        elif refusal is not None:
            # Of a press that ended the first reason is told until it is let go.
            entry.why = entry.why or (bar if refusal is Refusal.BARRED else refusal.value)
        return refusal

    def tell(self, page: int, now: float) -> dict[str, object]:
        """Return what to send to a page now: the count to echo, and what it should know."""
        entry = self._pages[page]
        self._count += 1
        entry.session.send(self._count, now)
        return {
            "count": self._count,
            "heard": entry.session.heard,
            "held": entry.session.state(now).pressed,
            "bar": self._bar(page, now),
            "why": entry.why,
        }

    def is_silent(self, page: int, now: float) -> bool:
        """Return whether a page has said nothing for too long."""
        return now - self._pages[page].session.heard_at > SILENCE

    def lapses(self, now: float) -> bool:
        """Return True once when the hold has ended by silence."""
        if self._owner is None or not self._pages[self._owner].session.lapses(now):
            return False
        self._pages[self._owner].why = _STALLED
        return True

    def state(self, now: float) -> HoldState:
        """Return the hold that counts."""
        return RELEASED if self._owner is None else self._pages[self._owner].session.state(now)

    def _bar(self, page: int, now: float) -> str:
        """Return why a page may only watch, and stop; empty: it may hold."""
        if why := self._why_not(self._pages[page].is_local):
            return why
        is_free = self._owner in (None, page) or now - self._held_at > IDLE
        return "" if is_free else OTHER_PAGE
