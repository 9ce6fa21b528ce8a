"""A page of the console under a finger: what its script does, `static/hold.js`, in virtual time."""

from __future__ import annotations

import dataclasses
import json
from collections import deque
from collections.abc import Callable

from needle_verification.soak.virtual_line import VirtualLine
from needle_verification.soak.virtual_world import NANOSECONDS, VirtualWorld

_RETRY_NS = NANOSECONDS
# Without a word for so long the link is not called open [ns].
_SILENCE_NS = NANOSECONDS // 2
# So often the page looks for the finger, and sends what it is made to [ns].
_LOOK_NS = 10_000_000
_GARBAGE = ("", "{}", "[1]", '{"nonce": 1}', "\x00", '{"pressed": true, "speed": 1e999}')
_KEPT = 50


@dataclasses.dataclass
class _Press:
    mode: str
    # Number of its first message.
    sequence: int


class VirtualPage:
    """Tells over its line what the finger does, as often as it is asked.

    Parameters
    ----------
    world : VirtualWorld
        Its time and chance.
    line : VirtualLine
        To the console.
    finger : callable
        Returns the button that is under the finger: `insert`, `retract`, or none (empty).

    Attributes
    ----------
    sends_garbage, repeats : bool
        Whether it sends, beside its own messages, what nobody understands, or old ones of its own.
    """

    def __init__(self, world: VirtualWorld, line: VirtualLine, finger: Callable[[], str]) -> None:
        self._world = world
        self._line = line
        self._finger = finger
        self._chance = world.chance("page")
        self.sends_garbage = self.repeats = False
        self._sent: deque[str] = deque(maxlen=_KEPT)
        self._frozen = False
        self._happened: list[Callable[[], None]] = []
        self._is_open = False
        self.open()
        self._look()

    @property
    def asks_for_a_new_press(self) -> bool:
        """Whether it shows that the finger holds nothing: the press was lost, or the link is."""
        return self._lost or self._world.steady_ns - self._heard_ns > _SILENCE_NS

    def open(self) -> None:
        """Load the page: a finger that is down already is none until it comes anew."""
        if self._is_open:
            return
        self._is_open = True
        self._nonce = ""
        self._sequence = 0
        self._press: _Press | None = None
        self._lost = False
        self._heard_ns = -_SILENCE_NS
        self._under_finger = self._finger()
        self._connect()

    def close(self) -> None:
        """Take the page away, whatever it was doing."""
        self._is_open = False
        self._connection.abort(self._connection.to_page)
        self._happened.clear()

    def freeze(self) -> None:
        """Do nothing more: what comes waits."""
        self._frozen = True

    def go_on(self) -> None:
        """Do what has waited; the finger comes first, as in a browser."""
        self._frozen = False
        self._see_finger()
        happened, self._happened = self._happened, []
        for act in happened:
            act()

    def hear(self, text: str) -> None:
        """Take a message of the console."""
        self._do(lambda: self._hear(text))

    def see_end(self) -> None:
        """Take that the connection is gone."""
        self._do(self._lose_connection)

    def _do(self, act: Callable[[], None]) -> None:
        if self._frozen:
            self._happened.append(act)
        else:
            act()

    # ---- the connection -----------------------------------------------------------------------

    def _connect(self) -> None:
        self._connection = self._line.connect(self)
        self._connection.to_server.send(json.dumps({"token": ""}))

    def _lose_connection(self) -> None:
        self._drop()
        self._nonce = ""
        self._sequence = 0
        gone = self._connection

        def retry() -> None:
            if self._is_open and self._connection is gone:
                self._connect()

        self._world.call_after(_RETRY_NS, lambda: self._do(retry))

    def _hear(self, text: str) -> None:
        self._see_finger()
        told = json.loads(text)
        self._nonce = told["nonce"]
        self._heard_ns = self._world.steady_ns
        # Once lost, a press is over, whatever the finger does.
        if self._press and told["heard"] >= self._press.sequence and not told["held"]:
            self._drop()
        self._send()

    def _send(self) -> None:
        if not self._nonce:
            return
        self._sequence += 1
        message = {
            "nonce": self._nonce,
            "sequence": self._sequence,
            "pressed": self._press is not None,
            "speed": 1.0,
            "mode": self._press.mode if self._press else "insert",
        }
        text = json.dumps(message)
        self._sent.append(text)
        self._connection.to_server.send(text)

    # ---- the finger ---------------------------------------------------------------------------

    def _look(self) -> None:
        if self._is_open and not self._frozen:
            self._see_finger()
            if self.sends_garbage:
                self._connection.to_server.send(self._chance.choice(_GARBAGE))
            if self.repeats and self._sent:
                self._connection.to_server.send(self._chance.choice(self._sent))
        self._world.call_after(_LOOK_NS, self._look)

    def _see_finger(self) -> None:
        before, self._under_finger = self._under_finger, self._finger()
        if self._under_finger == before:
            return
        if self._press:
            self._press = None
            self._send()
        self._lost = False
        if self._under_finger and not before:
            self._press = _Press(self._under_finger, self._sequence + 1)
            self._send()

    def _drop(self) -> None:
        if self._press:
            self._press = None
            self._lost = True
