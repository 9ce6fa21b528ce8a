"""Protocol between the pages and the console: owner of the hold, messages and time limits."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable

from needle_console.hold.page_session import (
    ECHO_AGE_LIMIT,
    RELEASED,
    HoldRefusal,
    PageHold,
    PageSession,
    read_message,
)

PERIOD = 0.02
"""Period of the counts sent to each page, and of the reported hold [s]."""

IDLE_PERIOD = 0.08
"""Period of the reported hold without a page; releases are reported at more than 10 Hz [s]."""

SILENCE = 5.0
"""Time without a message after which a page is disconnected [s]."""

IDLE = 30.0
"""Time without a press after which other pages may take over the hold [s]."""

OTHER_PAGE = "another page steers"
_STALLED = f"no echo from this page for {ECHO_AGE_LIMIT:g} s (browser, network or console stalled)"

# The expiry of a hold is checked this long after its end [s].
_TICK = 1e-4


@dataclasses.dataclass
class _Page:
    session: PageSession
    is_local: bool
    # Reason why its last press does not count; empty if it counts or the button is released.
    why: str = ""


class HoldProtocol:
    """Handles the messages of all pages; `now` is the monotonic time [s] in every method.

    The first page that presses owns the hold until it disconnects or is idle, so that another page
    cannot take it over between two presses.

    Parameters
    ----------
    refusal_reason : callable
        Returns the reason why a page may only watch, empty if it may hold; its argument is whether
        the page is shown on the rig's own machine.
    on_state : callable
        Receives the hold every `PERIOD` (`IDLE_PERIOD` without a page) and on each change.
    on_notice : callable
        Receives lines for the log.
    now : float
        Time of the start.
    """

    def __init__(
        self,
        refusal_reason: Callable[[bool], str],
        on_state: Callable[[PageHold], None],
        on_notice: Callable[[str], None],
        now: float,
    ) -> None:
        self._refusal_reason = refusal_reason
        self._on_state = on_state
        self._on_notice = on_notice
        # All keys are set from the start, because another thread may read it.
        self._refusals = dict.fromkeys(HoldRefusal, 0)
        # Common to all pages, so that no two connections receive the same count.
        self._count = 0
        self._pages: dict[int, _Page] = {}
        self._last_page = 0
        self._owner: int | None = None
        self._held_at = -math.inf
        self._reported = RELEASED
        self._due = now

    def open(self, now: float, *, is_local: bool) -> int:
        """Add a page; return its number."""
        self._last_page += 1
        self._pages[self._last_page] = _Page(PageSession(now), is_local)
        return self._last_page

    def close(self, page: int, now: float) -> None:
        """Remove a page; its hold ends."""
        del self._pages[page]
        if self._owner == page:
            self._owner = None
        self._report_change(now)

    def receive(self, page: int, data: str | bytes, now: float) -> HoldRefusal | None:
        """Receive a page's message; return the refusal, if any. An invalid one ends the hold."""
        self._end_if_stale(now)
        refusal = self._receive(page, data, now)
        if refusal is not None:
            self.refuse(refusal)
        self._report_change(now)
        return refusal

    def message_for(self, page: int, now: float) -> str:
        """Return the message to send to a page every `PERIOD`: a count to echo, and its state."""
        self._end_if_stale(now)
        entry = self._pages[page]
        self._count += 1
        entry.session.record_sent(self._count, now)
        fields = {
            "count": self._count,
            "heard": entry.session.echoed,
            "held": entry.session.state(now).pressed,
            "bar": self._watch_only_reason(page, now),
            "why": entry.why,
        }
        return json.dumps(fields)

    def is_silent(self, page: int, now: float) -> bool:
        """Return whether a page has been silent for too long; if so, count a refusal."""
        if now - self._pages[page].session.received_at <= SILENCE:
            return False
        self.refuse(HoldRefusal.SILENT)
        return True

    def state(self, now: float) -> PageHold:
        """Return the hold of the owner."""
        return RELEASED if self._owner is None else self._pages[self._owner].session.state(now)

    def update(self, now: float) -> float:
        """Report the hold if it is due or has expired; return the time of the next call [s]."""
        period = PERIOD if self._pages else IDLE_PERIOD
        # The first page to connect shortens the period.
        self._due = min(self._due, now + period)
        if now >= self._due or (self._reported.pressed and now > self._until):
            self._report(now)
            while self._due <= now:
                self._due += period
        if not self._reported.pressed:
            return self._due
        return min(self._due, max(self._until, now) + _TICK)

    def refuse(self, refusal: HoldRefusal, detail: str = "") -> None:
        """Count a refusal, and log the first of its kind."""
        self._refusals[refusal] += 1
        if self._refusals[refusal] == 1:
            self._on_notice(f"hold: {refusal.value}" + (f" ({detail})" if detail else ""))

    def counts(self) -> dict[str, int]:
        """Return the number of refusals of each kind; any thread may call this."""
        return {refusal.value: number for refusal, number in self._refusals.items() if number}

    @property
    def _until(self) -> float:
        """Time at which the hold ends unless a message arrives [s]; -inf if there is no hold."""
        return -math.inf if self._owner is None else self._pages[self._owner].session.until

    def _receive(self, page: int, data: str | bytes, now: float) -> HoldRefusal | None:
        entry = self._pages[page]
        try:
            count, hold = read_message(data)
        except ValueError:
            entry.session.end()
            return HoldRefusal.INVALID
        reason = self._watch_only_reason(page, now)
        refusal = entry.session.receive(count, hold, now, may_hold=not reason)
        holds = entry.session.state(now).pressed
        if holds:
            self._owner = page
            self._held_at = now
        if holds or not hold.pressed:
            entry.why = ""
        elif refusal is not None:
            # Keep the first reason until the button is released.
            entry.why = entry.why or (reason if refusal is HoldRefusal.BARRED else refusal.value)
        return refusal

    def _watch_only_reason(self, page: int, now: float) -> str:
        """Return the reason why a page may only watch and stop; empty if it may hold."""
        if why := self._refusal_reason(self._pages[page].is_local):
            return why
        is_free = self._owner in (None, page) or now - self._held_at > IDLE
        return "" if is_free else OTHER_PAGE

    def _end_if_stale(self, now: float) -> None:
        """End an expired hold; after a stall, the first method that runs does this."""
        if self._owner is not None and self._pages[self._owner].session.end_if_stale(now):
            self._pages[self._owner].why = _STALLED
            self.refuse(HoldRefusal.LOST, "no recent message from the page; press again")

    def _report(self, now: float) -> None:
        self._end_if_stale(now)
        self._reported = self.state(now)
        self._on_state(self._reported)

    def _report_change(self, now: float) -> None:
        if self.state(now) != self._reported:
            self._report(now)
