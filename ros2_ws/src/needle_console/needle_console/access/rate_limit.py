"""A bound on how often something may come."""

from __future__ import annotations


class RateLimit:
    """Lets through `rate` a second for long, `burst` at once.

    Parameters
    ----------
    rate : float
        How many a second [Hz].
    burst : int
        How many at once.
    """

    def __init__(self, rate: float, burst: int) -> None:
        self._rate = rate
        self._burst = float(burst)
        self._left = float(burst)
        self._time: float | None = None

    def lets_through(self, now: float) -> bool:
        """Take one more that came now [s]; return whether it is within the bound."""
        if self._time is not None:
            self._left = min(self._burst, self._left + self._rate * max(now - self._time, 0.0))
        self._time = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True
