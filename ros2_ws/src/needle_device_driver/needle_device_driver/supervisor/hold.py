"""Hold to run: whose press counts, how fresh it is, how fast it lets things go."""

from __future__ import annotations

import dataclasses
import math

from needle_core.foreign_text import plain
from needle_device_driver.rules import Rule

MAX_SENDERS = 16
LONGEST_NAME = 64

# So much may a press's way here be quicker than that of the release before it [ns].
_JITTER_NS = 20_000_000


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
    lifetime : float
        How long it counts by its sender's own word [s]; never longer than the time-out.
    """

    sender: str
    stamp_ns: int
    pressed: bool
    speed_scale: float
    lifetime: float = math.inf


@dataclasses.dataclass
class _Sender:
    # A press must be above it.
    stamp_ns: int
    pressed: bool
    arrival: float
    timeout: float
    # Whether a release came since the last press.
    armed: bool
    # Time from stamp to arrival of a release that was stamped before a reset [ns].
    delay_ns: int | None = None


class Hold:
    """The hold to run of whoever may have it, its age measured by arrival.

    Parameters
    ----------
    timeout : float
        A message counts so long after its arrival [s], or as long as itself says if that is
        shorter.

    Attributes
    ----------
    presses : int
        How often a press has begun to count.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._senders: dict[str, _Sender] = {}
        self._owner: str | None = None
        self._speed_scale = 0.0
        self._lapsed = False
        self._spent_ns: int | None = None
        self._strangers_armed = True
        self.presses = 0

    @property
    def owner(self) -> str | None:
        """Name of the holder; None without a press that counts."""
        return self._owner

    def unheeded(self, now: float) -> str | None:
        """Return who presses while nobody's press counts, and must release first; None: nobody."""
        if self._owner is not None:
            return None
        return next((name for name, s in self._senders.items() if self._presses(s, now)), None)

    @property
    def speed_scale(self) -> float:
        """The owner's share of the nominal speed, 0 without owner."""
        return self._speed_scale if self._owner is not None else 0.0

    def age(self, now: float) -> float:
        """Return the time since the owner was last heard [s]; infinite without owner."""
        return math.inf if self._owner is None else now - self._senders[self._owner].arrival

    def is_fresh(self, now: float) -> bool:
        """Return whether there is an owner who was heard within the time-out."""
        return self._owner is not None and self.age(now) <= self.timeout

    @property
    def timeout(self) -> float:
        """Time for which the owner's last message counts [s]; without owner, the longest of any."""
        return self._timeout if self._owner is None else self._senders[self._owner].timeout

    def is_off(self, now: float) -> bool:
        """Return whether nobody who was heard within the time-out presses."""
        return not any(self._presses(sender, now) for sender in self._senders.values())

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
        pressed = message.pressed and 0.0 <= scale <= 1.0 and message.lifetime > 0.0
        sender = self._senders.get(message.sender)
        if sender is None:
            if len(self._senders) >= MAX_SENDERS or len(message.sender) > LONGEST_NAME:
                return Rule.HOLD_ONE_OWNER
            sender = self._senders[message.sender] = _Sender(
                stamp_ns=message.stamp_ns - 1,
                pressed=False,
                arrival=now,
                timeout=self._timeout,
                armed=self._strangers_armed and not self._is_spent(message.stamp_ns),
            )
        if pressed and not self._is_new(sender, message.stamp_ns, now):
            return Rule.HOLD_STAMP_INCREASES
        sender.pressed = pressed
        sender.arrival = now
        sender.timeout = min(message.lifetime, self._timeout)
        if not pressed:
            self._take_release(sender, message.stamp_ns, now)
            if self._owner == message.sender:
                self._owner = None
            return Rule.SPEED_SCALE if message.pressed else None
        sender.stamp_ns = message.stamp_ns
        armed, sender.armed = sender.armed, False
        if self._owner == message.sender:
            self._speed_scale = scale
            self._lapsed = False
            return None
        if not armed or not counting:
            return Rule.HOLD_NEW_PRESS
        if self._owner is not None:
            return Rule.HOLD_ONE_OWNER
        self._owner = message.sender
        self.presses += 1
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

    def knows(self, sender: str) -> bool:
        """Return whether a sender is among those whose hold may count."""
        return sender in self._senders

    def readmit(self, now: float) -> None:
        """Let in who was shut out, as a person at the rig wants it; nobody's press counts then.

        Who is silent is forgotten, and a release may bear a lower stamp than was heard before. What
        was stamped before must not let anything move, though it comes late or twice: a press after
        such a release counts only if it was as long on its way, which nothing in a burst is, and
        nothing that follows an older one.

        Parameters
        ----------
        now : float
            Steady time [s].
        """
        self.require_new_press()
        for name, sender in tuple(self._senders.items()):
            if not self._is_spent(sender.stamp_ns):
                self._spent_ns = sender.stamp_ns
            if now - sender.arrival > self._timeout:
                del self._senders[name]
                # One that was cut off while it pressed may come back, still pressing.
                self._strangers_armed = self._strangers_armed and sender.armed

    def _presses(self, sender: _Sender, now: float) -> bool:
        return sender.pressed and now - sender.arrival <= sender.timeout

    def _is_spent(self, stamp_ns: int) -> bool:
        """Return whether a stamp is none above all that were heard before the last reset."""
        return self._spent_ns is not None and stamp_ns <= self._spent_ns

    def _is_new(self, sender: _Sender, stamp_ns: int, now: float) -> bool:
        """Return whether a press comes after what was heard, and in its time."""
        if stamp_ns <= sender.stamp_ns:
            sender.armed = False
            return False
        least = sender.delay_ns
        return least is None or _delay_ns(stamp_ns, now) >= least - _JITTER_NS

    def _take_release(self, sender: _Sender, stamp_ns: int, now: float) -> None:
        if self._is_spent(stamp_ns):
            delay, least = _delay_ns(stamp_ns, now), sender.delay_ns
            goes_on = least is not None and stamp_ns > sender.stamp_ns
            sender.delay_ns = min(delay, least) if least is not None and goes_on else delay
        elif stamp_ns > sender.stamp_ns:
            sender.delay_ns = None
        else:
            # It ends a hold like any other, but what follows it is no new press.
            return
        sender.stamp_ns = stamp_ns
        sender.armed = True


class HoldRefusals:
    """Notices of holds that do not count: each once, until it changes."""

    def __init__(self) -> None:
        # Those whose name is not known share one entry.
        self._rules: dict[str | None, Rule | None] = {}

    def clear(self) -> None:
        """Begin anew: everything is worth saying again."""
        self._rules.clear()

    def take(self, sender: str, rule: Rule | None, *, known: bool) -> str:
        """Take what became of a message, and return what there is to say; empty: nothing."""
        key = sender if known else None
        if rule is self._rules.get(key):
            return ""
        self._rules[key] = rule
        if rule is None:
            return ""
        lasting = rule is Rule.HOLD_STAMP_INCREASES or not known
        way_out = "; device/reset ends this" if lasting else ""
        return f"hold of '{plain(sender)}' does not count ({rule.value}){way_out}"


def _delay_ns(stamp_ns: int, arrival: float) -> int:
    return round(arrival * 1e9) - stamp_ns
