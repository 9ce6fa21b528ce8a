"""Clock of cycles in simulated time: with steady time at most, outside lock step."""

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
