"""Hold to run: whose press counts, how fresh it is, how fast it lets things go."""

from __future__ import annotations

import dataclasses
import math

from needle_device_driver.rules import Rule

MAX_SENDERS = 16


@dataclasses.dataclass(frozen=True)
class HoldMessage:
    """One message of an operator's hand.

    Attributes
    ----------
    sender : str
        Who says it.
    stamp_ns : int
        The sender's own count [ns]; must increase.
    pressed : bool
        Whether hold to run is pressed.
    speed_scale : float
        Share of the nominal speed, 0..1.
    """

    sender: str
    stamp_ns: int
    pressed: bool
    speed_scale: float


@dataclasses.dataclass
class _Sender:
    stamp_ns: int
    pressed: bool
    arrival: float


class Hold:
    """The hold to run of whoever may have it, its age measured by arrival.

    Parameters
    ----------
    timeout : float
        A message counts so long after its arrival [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._senders: dict[str, _Sender] = {}
        self._owner: str | None = None
        self._speed_scale = 0.0
        self._lapsed = False

    @property
    def owner(self) -> str | None:
        """Who holds; None: nobody whose press counts."""
        return self._owner

    @property
    def speed_scale(self) -> float:
        """The owner's share of the nominal speed, 0 without owner."""
        return self._speed_scale if self._owner is not None else 0.0

    def age(self, now: float) -> float:
        """Return the time since the owner was last heard [s]; infinite without owner."""
        return math.inf if self._owner is None else now - self._senders[self._owner].arrival

    def is_fresh(self, now: float) -> bool:
        """Return whether there is an owner who was heard within the time-out."""
        return self.age(now) <= self._timeout

    def is_off(self, now: float) -> bool:
        """Return whether nobody who was heard within the time-out presses."""
        return not any(
            sender.pressed and now - sender.arrival <= self._timeout
            for sender in self._senders.values()
        )

    def receive(  # noqa: PLR0911 - each return is a rule
        self, message: HoldMessage, now: float, *, counting: bool
    ) -> Rule | None:
        """Take one message.

        Parameters
        ----------
        message : HoldMessage
            What was received.
        now : float
            Its arrival on the steady clock [s].
        counting : bool
            Whether a press may count at all in the device's present state.

        Returns
        -------
        Rule or None
            The rule that kept a press from counting.
        """
        scale = message.speed_scale
        # What cannot be understood counts as the safe thing, a release.
        pressed = message.pressed and 0.0 <= scale <= 1.0
        sender = self._senders.get(message.sender)
        if sender is None:
            if len(self._senders) >= MAX_SENDERS:
                return Rule.HOLD_ONE_OWNER
            sender = _Sender(stamp_ns=message.stamp_ns, pressed=False, arrival=now)
            self._senders[message.sender] = sender
        elif pressed and message.stamp_ns <= sender.stamp_ns:
            return Rule.HOLD_STAMP_INCREASES
        was_pressed = sender.pressed
        sender.stamp_ns = max(sender.stamp_ns, message.stamp_ns)
        sender.pressed = pressed
        sender.arrival = now
        if not pressed:
            if self._owner == message.sender:
                self._owner = None
            return Rule.SPEED_SCALE if message.pressed else None
        if self._owner == message.sender:
            self._speed_scale = scale
            self._lapsed = False
            return None
        if was_pressed or not counting:
            return Rule.HOLD_NEW_PRESS
        if self._owner is not None:
            return Rule.HOLD_ONE_OWNER
        self._owner = message.sender
        self._speed_scale = scale
        self._lapsed = False
        return None

    def lapses(self, now: float) -> bool:
        """Return True once when the owner falls silent for longer than the time-out."""
        if self._owner is None or self._lapsed or self.is_fresh(now):
            return False
        self._lapsed = True
        return True

    def require_new_press(self) -> None:
        """Take the hold from its owner; who presses now must release first to count again."""
        self._owner = None
