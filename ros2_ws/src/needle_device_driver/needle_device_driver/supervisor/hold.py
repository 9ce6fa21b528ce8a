"""Hold to run: whose press counts, how fresh it is, how fast it lets things go."""

from __future__ import annotations

import collections
import dataclasses
import math

from needle_core.diagnostics import sanitize
from needle_core.messages import HoldState
from needle_device_driver.rules import Rule

MAX_SOURCES = 16
# Sessions of a source that are remembered as over. They cannot be told by their order: the clock
# that names them may be set back. A message is late by seconds, and nobody restarts as often then.
_MAX_REPLACED = 16
# Below every count.
_NOTHING_HEARD = -1


@dataclasses.dataclass
class _Source:
    session: str
    # Whether a release came since the last press.
    released: bool
    arrival: float
    count: int = _NOTHING_HEARD
    # Last moment of its press; minus infinity: it does not press.
    until: float = -math.inf
    replaced: collections.deque[str] = dataclasses.field(
        default_factory=lambda: collections.deque(maxlen=_MAX_REPLACED)
    )

    def begin(self, session: str) -> None:
        """Let a new session take the place of the present one, for good."""
        self.replaced.append(self.session)
        self.session, self.count = session, _NOTHING_HEARD
        self.released, self.until = False, -math.inf


class Hold:
    """The hold to run of whoever may have it, its age measured by arrival.

    Parameters
    ----------
    timeout : float
        A message counts so long after its arrival [s], or as long as itself says if that is
        shorter.

    Attributes
    ----------
    ignored : int
        How many messages came late, twice, or from a session that is over.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._sources: dict[str, _Source] = {}
        self._owner: str | None = None
        self._speed_scale = 0.0
        self.ignored = 0

    @property
    def owner(self) -> str | None:
        """Name of the holder; None without a press that counts."""
        return self._owner

    def unheeded(self, now: float) -> str | None:
        """Return who presses while nobody's press counts, and must release first; None: nobody."""
        if self._owner is not None:
            return None
        return next((name for name, one in self._sources.items() if now <= one.until), None)

    @property
    def speed_scale(self) -> float:
        """The owner's share of the nominal speed, 0 without owner."""
        return self._speed_scale if self._owner is not None else 0.0

    @property
    def until(self) -> float:
        """Last moment in which the owner's press counts [s]; minus infinity without owner."""
        return -math.inf if self._owner is None else self._sources[self._owner].until

    def is_fresh(self, now: float) -> bool:
        """Return whether there is an owner who was heard within the time-out."""
        return now <= self.until

    def is_off(self, now: float) -> bool:
        """Return whether nobody who was heard within the time-out presses."""
        return all(now > source.until for source in self._sources.values())

    def receive(self, message: HoldState, now: float, *, counting: bool) -> Rule | None:
        """Take one message.

        Parameters
        ----------
        message : HoldState
            What was received.
        now : float
            Its arrival on the steady clock [s].
        counting : bool
            Whether a press may count at all in the device's present state.

        Returns
        -------
        Rule or None
            The rule that kept a message from counting.
        """
        source = self._source_of(message, now)
        if source is None:
            return Rule.HOLD_ONE_OWNER
        is_owner = self._owner == message.source
        if message.session != source.session and message.session not in source.replaced:
            source.begin(message.session)
            if is_owner:
                self._owner = None
                is_owner = False
        if message.session != source.session or message.count <= source.count:
            self.ignored += 1
            return Rule.HOLD_IN_ORDER
        source.count, source.arrival = message.count, now
        scale = message.speed_scale
        # What cannot be understood counts as the safe thing, a release.
        if not (message.pressed and 0.0 <= scale <= 1.0 and message.lifetime > 0.0):
            source.until, source.released = -math.inf, True
            if is_owner:
                self._owner = None
            return Rule.SPEED_SCALE if message.pressed else None
        source.until = now + min(message.lifetime, self._timeout)
        released, source.released = source.released, False
        if not is_owner:
            if not released or not counting:
                return Rule.HOLD_NEW_PRESS
            if self._owner is not None:
                return Rule.HOLD_ONE_OWNER
            self._owner = message.source
        self._speed_scale = scale
        return None

    def lapse(self, now: float) -> str:
        """End a hold whose owner fell silent for too long; return what to say, empty: it is none.

        It takes a release and a new press.
        """
        if self._owner is None or self.is_fresh(now):
            return ""
        source = self._sources[self._owner]
        self.require_new_press()
        lasted = source.until - source.arrival
        return f"no hold message for {now - source.arrival:.3f} s, limit {lasted:g} s"

    def require_new_press(self) -> None:
        """Take the hold from its owner; who presses now must release first to count again."""
        self._owner = None

    def knows(self, source: str) -> bool:
        """Return whether a source is among those whose hold may count."""
        return source in self._sources

    def readmit(self) -> None:
        """Let in a source without a session whose stamps were once ahead; nobody's press counts.

        Who names a session begins with a count of its own, and needs no such way out.
        """
        self.require_new_press()
        for source in self._sources.values():
            if not source.session:
                source.count = _NOTHING_HEARD

    def _source_of(self, message: HoldState, now: float) -> _Source | None:
        """Return what is known of a message's source; None where there are too many.

        One that is first heard has to release before it counts. Only without a session, as typed by
        hand, its first press counts.
        """
        source = self._sources.get(message.source)
        if source is not None:
            return source
        if len(self._sources) >= MAX_SOURCES:
            oldest = min(self._sources, key=lambda name: self._sources[name].arrival)
            if now - self._sources[oldest].arrival <= self._timeout:
                return None
            # Should it come back it is as if first heard.
            del self._sources[oldest]
        source = _Source(message.session, released=not message.session, arrival=now)
        self._sources[message.source] = source
        return source


class HoldRefusals:
    """Notices of holds that do not count: each once, until it changes."""

    def __init__(self) -> None:
        # Those whose name is not known share one entry. What is ignored changes nothing, and may
        # come between messages that count: it has an entry of its own.
        self._rules: dict[tuple[str | None, bool], Rule | None] = {}

    def clear(self) -> None:
        """Begin anew: everything is worth saying again."""
        self._rules.clear()

    def take(self, message: HoldState, rule: Rule | None, *, known: bool) -> str:
        """Take what became of a message, and return what there is to say; empty: nothing."""
        ignored = rule is Rule.HOLD_IN_ORDER
        key = message.source if known else None, ignored
        if rule is self._rules.get(key):
            return ""
        self._rules[key] = rule
        if rule is None:
            return ""
        way_out = "; device/reset ends this" if ignored and not message.session else ""
        return f"hold of '{sanitize(message.sender)}' does not count ({rule.value}){way_out}"
