"""A page of the console under a finger: what its script does, `static/hold.js`, in virtual time."""

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
# Without a word for so long the link is not called open [s].
_SILENCE = 0.5
# So often the page looks for the finger, and sends what it is made to [s].
_LOOK = 0.01
_GARBAGE = ("", "{}", "[1]", '{"count": 1}', "\x00", '{"pressed": true, "speed": 1e999}')
_KEPT = 50
CONNECT = "connect"
"""First word on a connection, in place of a WebSocket's request."""


@dataclasses.dataclass(frozen=True)
class PageMessage:
    """A word on the line between page and console.

    Attributes
    ----------
    connection : int
        Which: a page that connects again takes another one.
    text : str or None
        A message; None: the connection ends.
    """

    connection: int
    text: str | None = None


@dataclasses.dataclass
class _Press:
    mode: str
    # The newest count when it began.
    after: int


class Page(Component):
    """Tells over its line what the finger does, as often as it is asked.

    A finger that is down already when it is loaded is none until it comes anew.

    Parameters
    ----------
    finger : callable
        Returns the button that is under the finger: `insert`, `retract`, or none (empty).
    chance : Random
        Draws what it is made to send, and the number of its connection.

    Attributes
    ----------
    sends_garbage, repeats : bool
        Whether it sends, beside its own messages, what nobody understands, or old ones of its own.
    """

    name = "page"

    def __init__(self, finger: Callable[[], str], chance: random.Random) -> None:
        self._finger, self._chance = finger, chance
        self.sends_garbage = self.repeats = False
        self._sent: deque[str] = deque(maxlen=_KEPT)
        self._connection = 0
        # When it connects again: where nobody answers, too.
        self._retry_at = 0.0
        self._is_cut = False
        self._count = 0
        self._press: _Press | None = None
        self._lost = False
        self._received_at = -_SILENCE
        self._under_finger = finger()
        self.ports = (Port(PAGE_LINE, self._handle_batch),)
        self.timers = (Timer(_LOOK, self._look),)

    def asks_for_a_new_press(self, now: float) -> bool:
        """Tell whether it shows that the finger holds nothing: the press is lost, or the link."""
        return self._lost or now - self._received_at > _SILENCE

    def cut(self) -> None:
        """Let the connection end, as the kernel does for a server that is gone."""
        self._is_cut = True

    def on_stop(self, at: Moment) -> Actions:
        """Go away: the connection ends."""
        yield Send(PAGE_LINE, (PageMessage(self._connection),))
        yield Exit(0)

    # ---- the connection -------------------------------------------------------------------------

    def _handle_batch(self, batch: Sequence[PageMessage], at: Moment) -> Actions:
        # The finger comes first, as in a browser that stood still.
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

    def _handle_message(self, told: dict[str, object], at: Moment) -> Actions:
        self._retry_at = math.inf
        self._count = int(str(told["count"]))
        self._received_at = at.steady
        # Once lost, a press is over, whatever the finger does.
        if self._press and int(str(told["heard"])) > self._press.after and not told["held"]:
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

    def _look(self, at: Moment) -> Actions:
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
            # The next count is answered with it.
            self._press = _Press(self._under_finger, self._count)

    def _drop(self) -> None:
        if self._press:
            self._press = None
            self._lost = True
