"""Hold of one page: validity of its messages, and expiry of the hold."""

from __future__ import annotations

import collections
import dataclasses
import enum
import json
import math

OWNER = "console"
"""Source of the console's hold messages."""

# The hold must end within 0.3 s. A shorter limit would end it on a busy machine, where browsers
# stall for more than 0.1 s.
ECHO_AGE_LIMIT = 0.25
"""Time for which a message is valid after the count that it echoes was sent [s]."""

# Number of sent counts that are stored, for five seconds.
_MAX_SENT = 250

_KEYS = {"count", "pressed", "speed", "mode"}


class Mode(enum.Enum):
    """Purpose of a press."""

    INSERT = "insert"
    RETRACT = "retract"


@dataclasses.dataclass(frozen=True)
class PageHold:
    """State of a page's hold button.

    Attributes
    ----------
    pressed : bool
        Whether it is pressed.
    speed : float
        Share of the nominal speed, 0..1.
    mode : Mode
        Purpose of the press.
    """

    pressed: bool
    speed: float
    mode: Mode


RELEASED = PageHold(False, 0.0, Mode.INSERT)


class HoldRefusal(enum.Enum):
    """Reasons why a connection or message does not count; the value is shown to the user."""

    HOST = "foreign Host"
    ORIGIN = "foreign Origin"
    PATH = "unknown path"
    INVALID = "invalid message"
    ECHO = "no new echo on this connection"
    STALE = "message too old"
    NEW_PRESS = "press again"
    BARRED = "page may not hold"
    LOST = "hold lost"
    SILENT = "silent page"


def read_message(data: str | bytes) -> tuple[int, PageHold]:
    """Read a page's message: the newest count that it received, and its button.

    Raises
    ------
    ValueError
        If anything differs from the protocol: keys, types, or a speed outside 0..1.
    """
    fields = json.loads(data)
    if not isinstance(fields, dict) or fields.keys() != _KEYS:
        raise ValueError("other keys")
    count, pressed, speed = fields["count"], fields["pressed"], fields["speed"]
    if type(count) is not int or type(pressed) is not bool or type(speed) not in (int, float):
        raise ValueError("other types")
    if not 0.0 <= speed <= 1.0:
        raise ValueError("speed outside 0..1")
    return count, PageHold(pressed, float(speed), Mode(fields["mode"]))


class PageSession:
    """Checks the messages of one connection; `now` is the monotonic time [s] in every method.

    A message may be delayed by page, browser, network or server, so it only proves that the button
    was pressed when the count that it echoes was sent. A hold therefore ends `ECHO_AGE_LIMIT`
    after the newest echoed count was sent, and a burst after a stall does not extend it.

    Parameters
    ----------
    now : float
        Time of the connection.

    Attributes
    ----------
    echoed : int
        The newest echoed count; 0 before the first.
    received_at : float
        Time of the last message, or of the connection [s].
    until : float
        Time at which the hold ends unless a new message arrives [s]; -inf if there is no hold.
    """

    def __init__(self, now: float) -> None:
        self.echoed = 0
        self.received_at = now
        self.until = -math.inf
        # Counts that were sent on this connection, with their times, from the last echoed one on.
        self._sent: collections.deque[tuple[int, float]] = collections.deque(maxlen=_MAX_SENT)
        self._armed = False
        self._hold = RELEASED

    def state(self, now: float) -> PageHold:
        """Return the hold of this page."""
        return RELEASED if now > self.until else self._hold

    def end_if_stale(self, now: float) -> bool:
        """End an expired hold, and return whether it had expired; a new press is required then."""
        if self.until == -math.inf or now <= self.until:
            return False
        self.end()
        return True

    def end(self) -> None:
        """End the hold; the next one requires a release and a new press."""
        self.until = -math.inf
        self._armed = False

    def record_sent(self, count: int, now: float) -> None:
        """Record a sent count, which must be greater than all earlier ones on any connection."""
        self._sent.append((count, now))

    def receive(
        self, count: int, hold: PageHold, now: float, *, may_hold: bool
    ) -> HoldRefusal | None:
        """Receive a message.

        Parameters
        ----------
        count : int
            Count that the message echoes.
        hold : PageHold
            State of the button.
        now : float
            Time of arrival [s].
        may_hold : bool
            Whether this page may hold now.

        Returns
        -------
        HoldRefusal or None
            Reason why the message does not count. A release ends the hold in any case.
        """
        self.received_at = now
        sent, refusal = self._check_echo(count, hold, now)
        if not hold.pressed:
            self.end()
            # The next press counts only after a recent release.
            self._armed = refusal is None
            return refusal
        if refusal is None and not may_hold:
            refusal = HoldRefusal.BARRED
            self.end()
        if now > self.until:
            # A press that does not count on arrival does not count later either.
            armed, self._armed = self._armed, False
            if refusal is None and not armed:
                refusal = HoldRefusal.NEW_PRESS
        elif refusal is None and hold.mode is not self._hold.mode:
            refusal = HoldRefusal.NEW_PRESS
            self.end()
        if refusal is None:
            self.until = max(self.until, sent + ECHO_AGE_LIMIT)
            self._hold = hold
        return refusal

    def _check_echo(
        self, count: int, hold: PageHold, now: float
    ) -> tuple[float, HoldRefusal | None]:
        """Return the time at which the echoed count was sent, and the reason to refuse it."""
        # A page sends a release immediately, so it may repeat the last echo.
        least = self.echoed + 1 if hold.pressed else self.echoed
        if not self._sent or not least <= count <= self._sent[-1][0]:
            return -math.inf, HoldRefusal.ECHO
        while self._sent[0][0] < count:
            self._sent.popleft()
        found, sent = self._sent[0]
        if found != count:
            # The count was sent on another connection.
            return -math.inf, HoldRefusal.ECHO
        self.echoed = count
        return sent, HoldRefusal.STALE if now - sent > ECHO_AGE_LIMIT else None
