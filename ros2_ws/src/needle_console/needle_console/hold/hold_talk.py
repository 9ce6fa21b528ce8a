"""The talk between pages and the taker of their hold: what is said, and when."""

from __future__ import annotations

import json
from collections.abc import Callable

from needle_console.hold.hold_arbiter import HoldArbiter
from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.hold.refusals import Refusal, Refusals

PERIOD = 0.02
"""Counts go to every page, and the hold's state to its taker, so often [s]."""

ALONE_PERIOD = 0.08
"""Without a page nobody can press: the release is only repeated, above 10 times a second [s]."""

# By so much later than a hold's end it is looked at [s].
_TICK = 1e-4


class HoldTalk:
    """Takes what pages say, and hands on the hold. `now` is everywhere the steady clock [s].

    Parameters
    ----------
    why_not : callable
        As of `HoldArbiter`.
    on_state : callable
        Takes the hold every `PERIOD`, without a page every `ALONE_PERIOD`, and at once when it
        changes.
    on_notice : callable
        Takes a line that is worth a warning.
    now : float
        When it begins.

    Attributes
    ----------
    refusals : Refusals
        What was refused or lost.
    """

    def __init__(
        self,
        why_not: Callable[[bool], str],
        on_state: Callable[[HoldState], None],
        on_notice: Callable[[str], None],
        now: float,
    ) -> None:
        self._on_state = on_state
        self._on_notice = on_notice
        self.refusals = Refusals()
        self._arbiter = HoldArbiter(why_not)
        self._told = RELEASED
        self._due = now

    def open(self, now: float, *, is_local: bool) -> int:
        """Let a page in; return its number."""
        return self._arbiter.open(now, is_local=is_local)

    def close(self, page: int, now: float) -> None:
        """Let a page go: what it held ends now."""
        self._arbiter.close(page)
        self._tell_change(now)

    def hear(self, page: int, data: str | bytes, now: float) -> None:
        """Take a page's message."""
        self._watch_silence(now)
        refusal = self._arbiter.receive(page, data, now)
        if refusal is not None:
            self.refuse(refusal)
        self._tell_change(now)

    def has_lost(self, page: int, now: float) -> bool:
        """Return whether a page is gone, to judge by its silence."""
        if not self._arbiter.is_silent(page, now):
            return False
        self.refuse(Refusal.SILENT)
        return True

    def word_for(self, page: int, now: float) -> str:
        """Return what to send a page, every `PERIOD`."""
        self._watch_silence(now)
        return json.dumps(self._arbiter.tell(page, now))

    def look(self, now: float) -> float:
        """Hand on the hold where it is time, or has run out; return when to look again [s]."""
        period = PERIOD if self._arbiter.has_pages else ALONE_PERIOD
        # Sooner than was meant where the first page has come.
        self._due = min(self._due, now + period)
        if now >= self._due or (self._told.pressed and now > self._arbiter.until):
            self._tell(now)
            while self._due <= now:
                self._due += period
        if not self._told.pressed:
            return self._due
        return min(self._due, max(self._arbiter.until, now) + _TICK)

    def refuse(self, refusal: Refusal, detail: str = "") -> None:
        """Count what does not count; the first of its kind is worth a line."""
        if self.refusals.count(refusal):
            self._on_notice(f"hold: {refusal.value}" + (f" ({detail})" if detail else ""))

    def _tell(self, now: float) -> None:
        self._watch_silence(now)
        self._told = self._arbiter.state(now)
        self._on_state(self._told)

    def _watch_silence(self, now: float) -> None:
        """End a hold whose page was silent; whatever is done first after a stall notes it."""
        if self._arbiter.lapses(now):
            self.refuse(Refusal.LOST, "no fresh word of the page; it takes a new press")

    def _tell_change(self, now: float) -> None:
        if self._arbiter.state(now) != self._told:
            self._tell(now)
