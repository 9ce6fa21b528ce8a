"""Model of a console page: the behaviour of `static/hold.js`, in virtual time."""

from __future__ import annotations

import dataclasses
import json
import math
import random
from collections import deque
from collections.abc import Callable, Sequence

from needle_core.component import Action, Actions, Component, Exit, Moment, Port, Send, Timer
from scenario.faults import PAGE_LINE

_RETRY = 1.0
# Silence after which the link counts as lost [s].
_SILENCE = 0.5
# Period in which the page samples the finger and sends [s].
_POLL_PERIOD = 0.01
_GARBAGE = ("", "{}", "[1]", '{"count": 1}', "\x00", '{"pressed": true, "speed": 1e999}')
_KEPT = 50
CONNECT = "connect"
"""First message on a connection, in place of a WebSocket's request."""


@dataclasses.dataclass(frozen=True)
class PageMessage:
    """A message between page and console.

    Attributes
    ----------
    connection : int
        Number of the connection; each new one has another number.
    text : str or None
        Text; None ends the connection.
    """

    connection: int
    text: str | None = None


@dataclasses.dataclass
class _Press:
    mode: str
    # Newest count at its start.
    after: int


class Page(Component):
    """Sends the state of the finger in reply to each count.

    A finger that is down when the page loads counts only after a new press.

    Parameters
    ----------
    finger : callable
        Returns the pressed button: `insert`, `retract`, or empty for none.
    chance : Random
        Draws garbage and connection numbers.

    Attributes
    ----------
    sends_garbage, repeats : bool
        Whether it also sends invalid messages, or repeats old ones.
    """

    name = "page"

    def __init__(self, finger: Callable[[], str], chance: random.Random) -> None:
        self._finger, self._chance = finger, chance
        self.sends_garbage = self.repeats = False
        self._sent: deque[str] = deque(maxlen=_KEPT)
        self._connection = 0
        # Time of the next connection attempt.
        self._retry_at = 0.0
        self._is_cut = False
        self._count = 0
        self._press: _Press | None = None
        self._lost = False
        self._received_at = -_SILENCE
        self._under_finger = finger()
        self.ports = (Port(PAGE_LINE, self._handle_batch),)
        self.timers = (Timer(_POLL_PERIOD, self._poll),)

    def asks_for_a_new_press(self, now: float) -> bool:
        """Return whether the page shows a lost press or a lost link."""
        return self._lost or now - self._received_at > _SILENCE

    def cut(self) -> None:
        """End the connection, as the kernel does for a terminated server."""
        self._is_cut = True

    def on_stop(self, at: Moment) -> Actions:
        """Close the page, which ends the connection."""
        yield Send(PAGE_LINE, (PageMessage(self._connection),))
        yield Exit(0)

    # ---- the connection -------------------------------------------------------------------------

    def _handle_batch(self, batch: Sequence[PageMessage], at: Moment) -> Actions:
        # Sample the finger first, as a resumed browser does.
        yield from self._update_finger()
        for message in batch:
            if message.connection != self._connection:
                continue
            if message.text is None:
                self._lose_connection(at.steady)
            else:
                yield from self._handle_message(json.loads(message.text), at)

    def _lose_connection(self, now: float) -> None:
        self._drop()
        self._count, self._is_cut = 0, False
        self._retry_at = now + _RETRY

    def _handle_message(self, message: dict[str, object], at: Moment) -> Actions:
        self._retry_at = math.inf
        self._count = int(str(message["count"]))
        self._received_at = at.steady
        # A lost press stays lost until a new one.
        if self._press and int(str(message["heard"])) > self._press.after and not message["held"]:
            self._drop()
        yield from self._publish_state()

    def _publish_state(self) -> Actions:
        if not self._count:
            return
        message = {
            "count": self._count,
            "pressed": self._press is not None,
            "speed": 1.0,
            "mode": self._press.mode if self._press else "insert",
        }
        text = json.dumps(message)
        self._sent.append(text)
        yield self._send(text)

    def _send(self, text: str) -> Action:
        return Send(PAGE_LINE, (PageMessage(self._connection, text),))

    # ---- the finger -----------------------------------------------------------------------------

    def _poll(self, at: Moment) -> Actions:
        yield from self._update_finger()
        if self._is_cut:
            self._lose_connection(at.steady)
        if at.steady >= self._retry_at:
            self._retry_at = at.steady + _RETRY
            self._connection = self._chance.getrandbits(32)
            yield self._send(CONNECT)
        if self.sends_garbage:
            yield self._send(self._chance.choice(_GARBAGE))
        if self.repeats and self._sent:
            yield self._send(self._chance.choice(self._sent))

    def _update_finger(self) -> Actions:
        before, self._under_finger = self._under_finger, self._finger()
        if self._under_finger == before:
            return
        if self._press:
            self._press = None
            yield from self._publish_state()
        self._lost = False
        if self._under_finger and not before:
            # The reply to the next count reports it.
            self._press = _Press(self._under_finger, self._count)

    def _drop(self) -> None:
        if self._press:
            self._press = None
            self._lost = True
