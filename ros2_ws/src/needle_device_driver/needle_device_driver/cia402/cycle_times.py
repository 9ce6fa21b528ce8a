"""Punctuality of the cycles: how many came late, and the longest time between two."""

from __future__ import annotations

_LATE = 0.5
"""Share of a period by which a cycle must come late to count."""


class CycleTimes:
    """Watches when cycles begin.

    Parameters
    ----------
    period : float
        Between cycles [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._begun: float | None = None
        self._longest = 0.0
        self._late = 0

    def begin(self, now: float) -> None:
        """Take that a cycle begins now, steady time [s]."""
        if self._begun is not None:
            between = now - self._begun
            self._longest = max(self._longest, between)
            self._late += between > (1.0 + _LATE) * self._period
        self._begun = now

    def take(self) -> dict[str, str]:
        """Return late cycles since the begin, and the longest time between two since last asked."""
        longest, self._longest = self._longest, 0.0
        return {"late_cycles": str(self._late), "longest_cycle_s": f"{longest:.4f}"}
