"""Hold to run: its owner, its age and its speed."""

from __future__ import annotations

import collections
import dataclasses
import math

from needle_core.diagnostics import sanitize
from needle_core.messages import HoldState
from needle_device_driver.rules import Rule

MAX_SOURCES = 16
# Number of ended sessions that are remembered per source. Sessions cannot be ordered by name,
# because the clock behind the name may be set back. Messages arrive at most seconds late, and no
# source restarts 16 times in that time.
_MAX_ENDED = 16
# Below every count.
_NO_COUNT = -1


@dataclasses.dataclass
class _Source:
    session: str
    # Whether a release arrived since the last press.
    released: bool
    arrival: float
    count: int = _NO_COUNT
    # End of its press; minus infinity if it does not press.
    until: float = -math.inf
    ended: collections.deque[str] = dataclasses.field(
        default_factory=lambda: collections.deque(maxlen=_MAX_ENDED)
    )

    def begin(self, session: str) -> None:
        """Begin a new session; the present one has ended and cannot resume."""
        self.ended.append(self.session)
        self.session, self.count = session, _NO_COUNT
        self.released, self.until = False, -math.inf


class Hold:
    """State of the hold to run; its age is measured from the arrival of messages.

    Parameters
    ----------
    timeout : float
        Longest lifetime of a message [s]; a message may have a shorter one.

    Attributes
    ----------
    ignored : int
        Number of messages that arrived late, twice, or from an ended session.
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._sources: dict[str, _Source] = {}
        self._owner: str | None = None
        self._speed_scale = 0.0
        self.ignored = 0

    @property
    def owner(self) -> str | None:
        """Source whose press counts; None: there is none."""
        return self._owner

    def ignored_press(self, now: float) -> str | None:
        """Return a source that presses without effect and must release first; None: none."""
        if self._owner is not None:
            return None
        return next((name for name, one in self._sources.items() if now <= one.until), None)

    @property
    def speed_scale(self) -> float:
        """The owner's share of the nominal speed, 0 without owner."""
        return self._speed_scale if self._owner is not None else 0.0

    @property
    def until(self) -> float:
        """Time at which the owner's press ends [s]; minus infinity without owner."""
        return -math.inf if self._owner is None else self._sources[self._owner].until

    def is_fresh(self, now: float) -> bool:
        """Return whether there is an owner whose last message has not expired."""
        return now <= self.until

    def is_off(self, now: float) -> bool:
        """Return whether no source presses; expired messages do not count."""
        return all(now > source.until for source in self._sources.values())

    def receive(self, message: HoldState, now: float, *, counting: bool) -> Rule | None:
        """Receive one message.

        Parameters
        ----------
        message : HoldState
            The message.
        now : float
            Steady time of its arrival [s].
        counting : bool
            Whether the state of the device allows a press to count.

        Returns
        -------
        Rule or None
            Rule that the message breaks; None if it counts.
        """
        source = self._source_of(message, now)
        if source is None:
            return Rule.HOLD_ONE_OWNER
        is_owner = self._owner == message.source
        if message.session != source.session and message.session not in source.ended:
            source.begin(message.session)
            if is_owner:
                self._owner = None
                is_owner = False
        if message.session != source.session or message.count <= source.count:
            self.ignored += 1
            return Rule.HOLD_IN_ORDER
        source.count, source.arrival = message.count, now
        scale = message.speed_scale
        # An invalid message counts as a release, which is safe.
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

    def end_if_stale(self, now: float) -> str:
        """End the hold if the owner's last message has expired; return the reason, if so.

        The next hold needs a release and a new press.
        """
        if self._owner is None or self.is_fresh(now):
            return ""
        source = self._sources[self._owner]
        self.require_new_press()
        lifetime = source.until - source.arrival
        return f"no hold message for {now - source.arrival:.3f} s, limit {lifetime:g} s"

    def require_new_press(self) -> None:
        """End the hold; a source that presses must release before its press counts again."""
        self._owner = None

    def knows(self, source: str) -> bool:
        """Return whether the state of a source is stored."""
        return source in self._sources

    def clear_rejections(self) -> None:
        """End the hold, and accept any next stamp of sources without a session.

        A source with a session does not need this: each session starts a new count.
        """
        self.require_new_press()
        for source in self._sources.values():
            if not source.session:
                source.count = _NO_COUNT

    def _source_of(self, message: HoldState, now: float) -> _Source | None:
        """Return the state of a message's source; None if there are too many sources.

        The first press of a new source does not count before a release. Messages without a session,
        which a person types, are exempt.
        """
        source = self._sources.get(message.source)
        if source is not None:
            return source
        if len(self._sources) >= MAX_SOURCES:
            oldest = min(self._sources, key=lambda name: self._sources[name].arrival)
            if now - self._sources[oldest].arrival <= self._timeout:
                return None
            del self._sources[oldest]
        source = _Source(message.session, released=not message.session, arrival=now)
        self._sources[message.source] = source
        return source


class HoldNotices:
    """Notices about holds that do not count, once until the reason changes."""

    def __init__(self) -> None:
        # Unknown sources share one entry. Ignored messages have entries of their own, because they
        # may arrive between messages that count.
        self._rules: dict[tuple[str | None, bool], Rule | None] = {}

    def clear(self) -> None:
        """Report every reason again."""
        self._rules.clear()

    def text_for(self, message: HoldState, rule: Rule | None, *, known: bool) -> str:
        """Return the notice about a message that breaks `rule`; empty: already given."""
        ignored = rule is Rule.HOLD_IN_ORDER
        key = message.source if known else None, ignored
        if rule is self._rules.get(key):
            return ""
        self._rules[key] = rule
        if rule is None:
            return ""
        hint = "; call device/reset" if ignored and not message.session else ""
        return f"hold of '{sanitize(message.sender)}' ignored ({rule.value}){hint}"
