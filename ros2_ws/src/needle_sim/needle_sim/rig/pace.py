"""Simulated time that keeps a fixed ratio to real time."""

from __future__ import annotations


class Pace:
    """Tells when the next tick of simulated time is due.

    Parameters
    ----------
    period : float
        Simulated time between ticks [s].
    real_time_factor : float
        Simulated over real time, above 0.
    """

    # A machine that was busy for longer loses the time: a burst of ticks would not be real time.
    MOST_BEHIND = 5

    def __init__(self, period: float, real_time_factor: float) -> None:
        self._interval = period / real_time_factor
        self._next: float | None = None
        self.lost_ticks = 0

    def wait(self, now: float) -> float:
        """Return how long until the next tick is due [s], steady clock; 0 when it is."""
        return 0.0 if self._next is None else max(self._next - now, 0.0)

    def tick(self, now: float) -> None:
        """Take that a tick was made."""
        if self._next is None:
            self._next = now
        self._next += self._interval
        behind = int((now - self._next) / self._interval)
        if behind > self.MOST_BEHIND:
            self._next += behind * self._interval
            self.lost_ticks += behind
