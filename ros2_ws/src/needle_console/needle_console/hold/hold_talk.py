"""The talk between pages and the taker of their hold: what is said, and when."""

from __future__ import annotations

import json
from collections.abc import Callable

from needle_console.access.rate_limit import RateLimit
from needle_console.hold.hold_arbiter import HoldArbiter
from needle_console.hold.hold_state import RELEASED, HoldState
from needle_console.hold.refusals import Refusal, Refusals

PERIOD = 0.02
"""Nonces go to every page, and the hold's state to its taker, so often [s]."""

ALONE_PERIOD = 0.08
"""Without a page nobody can press: the release is only repeated, above 10 times a second [s]."""

# By so much later than a hold's end it is looked at [s].
_TICK = 1e-4
# A page answers 50 times a second, and when its button changes.
_RATE, _BURST = 100.0, 50


class HoldTalk:
    """Takes what pages say, and hands on the hold. `now` is everywhere the steady clock [s].

    Parameters
    ----------
    make_nonce : callable
        Returns a text that nobody can guess.
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
        make_nonce: Callable[[], str],
        on_state: Callable[[HoldState], None],
        on_notice: Callable[[str], None],
        now: float,
    ) -> None:
        self._on_state = on_state
        self._on_notice = on_notice
        self.refusals = Refusals()
        self._arbiter = HoldArbiter(make_nonce)
        self._limits: dict[int, RateLimit] = {}
        self._told = RELEASED
        self._due = now

    def open(self, now: float) -> int | None:
        """Let a page in; return its number, or None where there are too many."""
        page = self._arbiter.open(now)
        if page is not None:
            self._limits[page] = RateLimit(_RATE, _BURST)
        return page

    def close(self, page: int, now: float) -> None:
        """Let a page go: what it held ends now."""
        del self._limits[page]
        self._arbiter.close(page)
        self._tell_change(now)

    def hear(self, page: int, data: str | bytes, now: float) -> bool:
        """Take a page's message; return whether it may go on: who floods may not."""
        if not self._limits[page].lets_through(now):
            self.refuse(Refusal.RATE)
            return False
        self._watch_silence(now)
        refusal = self._arbiter.receive(page, data, now)
        if refusal is not None:
            self.refuse(refusal)
        self._tell_change(now)
        return True

    def has_lost(self, page: int, now: float) -> bool:
        """Return whether a page is gone, to judge by its silence."""
        if not self._arbiter.is_silent(page, now):
            return False
        self.refuse(Refusal.SILENT)
        return True

    def word_for(self, page: int, now: float) -> str | None:
        """Return what to send a page, every `PERIOD`; None while it is behind with answers."""
        self._watch_silence(now)
        nonce = self._arbiter.issue(page, now)
        if nonce is None:
            return None
        return json.dumps({"nonce": nonce, **self._arbiter.tell(page, now)})

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
