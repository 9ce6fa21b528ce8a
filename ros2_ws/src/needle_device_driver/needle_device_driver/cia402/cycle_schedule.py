"""Times at which cycles are due."""

from __future__ import annotations


class CycleSchedule:
    """Keeps cycles a period apart on average, and never much closer than that.

    Who waits for a period after each cycle adds what waking up takes to every one of them. Here the
    next is due a period after this one was; but what a cycle is late by beyond `slack` is not made
    up for: set-points sent faster than the drives take them would be a speed that nobody asked for.

    Parameters
    ----------
    period : float
        Between cycles [s].
    slack : float
        By how much two cycles may be closer [s].

    Attributes
    ----------
    late : int
        How many cycles were not made up for in full.
    """

    def __init__(self, period: float, slack: float) -> None:
        self._period = period
        self._slack = slack
        self._due: float | None = None
        self._begun: float | None = None
        self._longest = 0.0
        self.late = 0

    def begin(self, now: float) -> float:
        """Take that a cycle begins now, steady clock [s]; return how long until the next [s]."""
        if self._begun is not None:
            self._longest = max(self._longest, now - self._begun)
        self._begun = now
        due = now if self._due is None else min(self._due, now)
        self.late += now > due + self._slack
        self._due = max(due, now - self._slack) + self._period
        return self._due - now

    def take_longest(self) -> float:
        """Return the longest time between two cycles since the last call [s]; 0 without any."""
        longest, self._longest = self._longest, 0.0
        return longest
