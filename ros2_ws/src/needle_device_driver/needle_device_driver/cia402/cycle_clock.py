"""Times at which cycles are due: on the steady clock, or in simulated time."""

from __future__ import annotations

# Simulated time comes with the jitter of the machine: a cycle may be this share of a period early.
_EARLY = 0.1
_NANOSECONDS = 1e9


class CycleClock:
    """Tells when a cycle is due by simulated time that others tell.

    Each cycle sends the set-points of one period. Cycles that come as fast as somebody tells time
    would be as fast a motion: so there is no more than one a period of steady time, whatever
    simulated time does. Only in lock step, where motors stand still without SYNC, it leads alone.

    Parameters
    ----------
    period_ns : int
        Of the cycle [ns].
    lock_step : bool
        Whether simulated time leads alone.
    """

    def __init__(self, period_ns: int, *, lock_step: bool) -> None:
        self._period_ns = period_ns
        self._period = period_ns / _NANOSECONDS
        self._lock_step = lock_step
        self._cycle_ns: int | None = None
        self._next_ns: int | None = None
        self._next_at = 0.0

    def tell(self, time_ns: int) -> bool:
        """Take the simulated time [ns]; return whether it repeats that of the last cycle."""
        if self._cycle_ns is not None and time_ns < self._cycle_ns:
            # Time was set back: another simulation.
            self._cycle_ns = None
        if self._cycle_ns is None or time_ns >= self._cycle_ns + self._period_ns:
            self._next_ns = time_ns
        return time_ns == self._cycle_ns

    def take(self, now: float) -> int | None:
        """Return the simulated time [ns] of a cycle that is due now [s]; None: none is."""
        if self._next_ns is None or self.wait(now) > 0.0:
            return None
        self._cycle_ns, self._next_ns = self._next_ns, None
        self._next_at = max(self._next_at, now) + self._period
        return self._cycle_ns

    @property
    def waits(self) -> bool:
        """Tell whether simulated time is ahead, and a cycle waits for steady time."""
        return self._next_ns is not None

    def wait(self, now: float) -> float:
        """Return how long steady time keeps the next cycle waiting [s]."""
        if self._lock_step:
            return 0.0
        return max(self._next_at - _EARLY * self._period - now, 0.0)


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
