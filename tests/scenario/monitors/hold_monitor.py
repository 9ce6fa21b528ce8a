"""Presses that reach the device, and which of them may move the needle."""

from __future__ import annotations

import dataclasses
import math

# Longest lifetime of a message [s] (docs/safety.md, hold_age).
_HOLD_AGE = 0.25


@dataclasses.dataclass
class _Press:
    # End of the lifetime of its messages [s].
    until: float
    # Whether the device reported its sender as the owner.
    owns: bool = False
    # Whether it can never count, because the device reported another owner meanwhile.
    spent: bool = False


class HoldMonitor:
    """Follows every hold that reaches the device, and the owner that the device reports.

    A hold has one owner until its release; a press of another source counts only after a release
    and a new press. So a press during which the device reports another owner, or none, must move
    nothing for as long as it lasts. The monitor uses no other rule of the device.

    Attributes
    ----------
    has_received : bool
        Whether any message was received.
    """

    def __init__(self) -> None:
        self.has_received = False
        self._presses: dict[str, _Press] = {}
        self._ended = -math.inf

    def receive(self, at: float, sender: str, *, pressed: bool, lifetime: float) -> None:
        """Receive a message at the same time as the device.

        Parameters
        ----------
        at : float
            When [s].
        sender : str
            Its source.
        pressed : bool
            Whether it is valid and reports a press.
        lifetime : float
            Its own lifetime [s].
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
        """Observe the owner that the device reports; empty if there is none."""
        self._end_lapsed(at)
        for sender, press in self._presses.items():
            if sender == owner:
                press.owns = True
                continue
            if press.owns and not press.spent:
                # A stop or a loss ended its hold.
                self._ended = at
            press.spent = True

    def lose_device(self, at: float) -> None:
        """Observe the end of the device; its drives may move until their watchdog stops them."""
        self._end_lapsed(at)
        for sender in tuple(self._presses):
            self._end(sender, at)

    def reset(self) -> None:
        """Reset, as a restarted device does."""
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
