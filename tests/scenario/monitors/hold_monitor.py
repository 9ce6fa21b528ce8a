"""Presses as the device hears them: which of them may move the needle, judged from outside."""

from __future__ import annotations

import dataclasses
import math

# A message counts for no longer, whatever it promises [s] (docs/safety.md, hold_age).
_HOLD_AGE = 0.25


@dataclasses.dataclass
class _Press:
    # Until when its messages make it last [s].
    until: float
    # Whether the device named its sender as the owner.
    owns: bool = False
    # Whether it can never count: it was there, and the device said that another had the hold.
    spent: bool = False


class HoldMonitor:
    """Hears every hold that reaches the device, and what that says of the owner.

    Hold to run has one owner, until it is let go; a press beside it takes a release and a new press
    to count. So a press that was there when the device named another owner, or nobody, is none by
    which anything may move, as long as it lasts. Nothing else of the device's own rules is known
    here.

    Attributes
    ----------
    hears : bool
        Whether anything was heard yet.
    """

    def __init__(self) -> None:
        self.has_received = False
        self._presses: dict[str, _Press] = {}
        self._ended = -math.inf

    def receive(self, at: float, sender: str, *, pressed: bool, lifetime: float) -> None:
        """Take a message as the device does.

        Parameters
        ----------
        at : float
            When [s].
        sender : str
            Whose it is.
        pressed : bool
            Whether it can be understood, and says so.
        lifetime : float
            How long it counts by its own word [s].
        """
        self.has_received = True
        self._end_lapsed(at)
        if not pressed:
            if sender in self._presses:
                self._end(sender, at)
            return
        until = at + min(lifetime, _HOLD_AGE)
        self._presses.setdefault(sender, _Press(until)).until = until

    def observe_owner(self, at: float, owner: str) -> None:
        """Take whose hold counts by the device's own word; empty: nobody's."""
        self._end_lapsed(at)
        for sender, press in self._presses.items():
            if sender == owner:
                press.owns = True
                continue
            if press.owns and not press.spent:
                # A stop, or a loss, has taken the hold from it.
                self._ended = at
            press.spent = True

    def lose_device(self, at: float) -> None:
        """Take that the device ended: by its drives' own watchdog what was under way may last."""
        self._end_lapsed(at)
        for sender in tuple(self._presses):
            self._end(sender, at)

    def forget(self) -> None:
        """Begin anew, as the device does that was started again."""
        self._presses.clear()

    def idle(self, at: float) -> float:
        """Return the time since the last moment in which a press could move the needle [s]."""
        live = [min(at, one.until) for one in self._presses.values() if not one.spent]
        return at - max((self._ended, *live))

    def _end_lapsed(self, at: float) -> None:
        for sender in [name for name, one in self._presses.items() if one.until < at]:
            self._end(sender, self._presses[sender].until)

    def _end(self, sender: str, at: float) -> None:
        if not self._presses.pop(sender).spent:
            self._ended = max(self._ended, at)
