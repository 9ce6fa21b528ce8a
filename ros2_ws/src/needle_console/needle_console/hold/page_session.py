"""One page's hold: which of its messages count, and until when."""

from __future__ import annotations

import collections
import math

from needle_console.hold.hold_state import RELEASED, HoldState, Mode
from needle_console.hold.page_message import PageMessage
from needle_console.hold.refusals import Refusal

# Browsers on a busy machine stall for more than 0.1 s; a page's hold must end within 0.3 s.
ECHO_AGE_LIMIT = 0.25
"""A message counts so long after the count that it echoes was sent: a press then is all that it
proves [s]."""

# Counts that are remembered, five seconds of them: who echoes none for so long is far behind.
_MAX_SENT = 250


class PageSession:
    """Judges what one connection of a page says. `now` is everywhere the steady clock [s].

    A message that came late proves a press of long ago, however it was held up: by page, browser,
    network or this server. So a hold ends `ECHO_AGE_LIMIT` after the newest count that a pressed
    message has echoed was sent, and a burst after a stall does not prolong it.

    Parameters
    ----------
    now : float
        When the page came.

    Attributes
    ----------
    heard : int
        The newest count that was echoed; 0 before.
    heard_at : float
        When the page was last heard, or came [s].
    """

    def __init__(self, now: float) -> None:
        self.heard = 0
        self.heard_at = now
        # Counts that were sent on this connection, and when; from the last echoed one on.
        self._sent: collections.deque[tuple[int, float]] = collections.deque(maxlen=_MAX_SENT)
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

    def send(self, count: int, now: float) -> None:
        """Note that a count is sent; it is above all before, on whatever connection."""
        self._sent.append((count, now))

    def receive(self, message: PageMessage, now: float, *, free: bool) -> Refusal | None:
        """Take a message.

        Parameters
        ----------
        message : PageMessage
            What was received.
        now : float
            Its arrival.
        free : bool
            Whether this page may hold now.

        Returns
        -------
        Refusal or None
            Why it does not count. A release ends the hold all the same.
        """
        self.heard_at = now
        sent, refusal = self._judge(message, now)
        if not message.pressed:
            self.end()
            # Only a release of now lets the next press count.
            self._armed = refusal is None
            return refusal
        if refusal is None and not free:
            refusal = Refusal.BARRED
            self.end()
        if now > self._until:
            # A press that does not count when it comes does not count later either.
            armed, self._armed = self._armed, False
            if refusal is None and not armed:
                refusal = Refusal.NEW_PRESS
        elif refusal is None and message.mode is not self._mode:
            refusal = Refusal.NEW_PRESS
            self.end()
        if refusal is None:
            self._until = max(self._until, sent + ECHO_AGE_LIMIT)
            self._speed, self._mode = message.speed, message.mode
        return refusal

    def _judge(self, message: PageMessage, now: float) -> tuple[float, Refusal | None]:
        """Return when the count that a message echoes was sent, and why it does not count."""
        # A release comes at once, without waiting for the next count: it may repeat the last echo.
        least = self.heard + 1 if message.pressed else self.heard
        if not self._sent or not least <= message.count <= self._sent[-1][0]:
            return -math.inf, Refusal.ECHO
        while self._sent[0][0] < message.count:
            self._sent.popleft()
        count, sent = self._sent[0]
        if count != message.count:
            # That one went to another connection.
            return -math.inf, Refusal.ECHO
        self.heard = count
        return sent, Refusal.STALE if now - sent > ECHO_AGE_LIMIT else None
