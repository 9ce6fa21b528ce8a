"""One page's hold: which of its messages count, and until when."""

from __future__ import annotations

import math
from collections.abc import Callable

from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_console.hold.nonces import Nonces
from needle_console.hold.page_message import PageMessage
from needle_console.hold.refusals import Refusal

# Browsers on a busy machine stall for more than 0.1 s; a page's hold must end within 0.3 s.
ECHO_AGE_LIMIT = 0.25
"""A message counts so long after its nonce was sent: a press then is all that it proves [s]."""


class PageSession:
    """Judges what one page says. `now` is everywhere the steady clock [s].

    A message that came late proves a press of long ago, however it was held up: by page, browser,
    network or this server. So a hold ends `ECHO_AGE_LIMIT` after the newest nonce that a pressed
    message has echoed was sent, and neither a burst nor a replay prolongs it.

    Parameters
    ----------
    make_nonce : callable
        Returns a text that nobody can guess.
    now : float
        When the page came.

    Attributes
    ----------
    nonces : Nonces
        What this page has to echo.
    heard : int
        Sequence number of the last message that was looked at; -1 before.
    heard_at : float
        When a nonce was last echoed, or the page came [s].
    """

    def __init__(self, make_nonce: Callable[[], str], now: float) -> None:
        self.nonces = Nonces(make_nonce)
        self.heard = -1
        self.heard_at = now
        self._armed = False
        self._until = -math.inf
        self._speed = 0.0
        self._mode = Mode.INSERT

    @property
    def until(self) -> float:
        """Time at which the hold ends unless more comes [s]; minus infinity without one."""
        return self._until

    def state(self, now: float) -> HoldState:
        """Return what this page's hand says."""
        if now > self._until:
            return RELEASED
        return HoldState(True, self._speed, self._mode)

    def lapses(self, now: float) -> bool:
        """Return True once when a hold has ended by itself; it takes a release and a new press."""
        if self._until == -math.inf or now <= self._until:
            return False
        self.end()
        return True

    def end(self) -> None:
        """End the hold, if there is one; it takes a release and a new press."""
        self._until = -math.inf
        self._armed = False

    def receive(self, message: PageMessage, now: float, *, free: bool) -> Refusal | None:
        """Take a message.

        Parameters
        ----------
        message : PageMessage
            What was received.
        now : float
            Its arrival.
        free : bool
            Whether no other page has the hold.

        Returns
        -------
        Refusal or None
            Why it does not count. A release ends the hold all the same.
        """
        issued, refusal = self._judge(message, now)
        if not message.pressed:
            self.end()
            # Only a release of now lets the next press count.
            self._armed = refusal is None
            return refusal
        if now > self._until:
            return self._begin(message, issued, refusal, free=free)
        if refusal is None and message.mode is not self._mode:
            self.end()
            return Refusal.NEW_PRESS
        if refusal is None:
            self._until = max(self._until, issued + ECHO_AGE_LIMIT)
            self._speed = message.speed
        return refusal

    def _judge(self, message: PageMessage, now: float) -> tuple[float, Refusal | None]:
        """Return when the message's nonce was sent, and why it does not count."""
        if message.sequence <= self.heard:
            return -math.inf, Refusal.REPEATED
        self.heard = message.sequence
        issued = self.nonces.take(message.nonce)
        if issued is None:
            return -math.inf, Refusal.NONCE
        self.heard_at = now
        return issued, Refusal.STALE if now - issued > ECHO_AGE_LIMIT else None

    def _begin(
        self, message: PageMessage, issued: float, refusal: Refusal | None, *, free: bool
    ) -> Refusal | None:
        # A press that does not count when it comes does not count later either.
        armed, self._armed = self._armed, False
        if refusal is not None:
            return refusal
        if not armed:
            return Refusal.NEW_PRESS
        if not free:
            return Refusal.OTHER_PAGE
        self._until = issued + ECHO_AGE_LIMIT
        self._speed = message.speed
        self._mode = message.mode
        return None
