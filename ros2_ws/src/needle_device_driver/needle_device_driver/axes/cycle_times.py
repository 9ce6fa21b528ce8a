"""Punctuality of the cycles."""

from __future__ import annotations

PERIOD = 0.02
"""Of the cycle: set-points, answers [s]."""
# A cycle is late if it begins later by this share of a period.
_LATE = 0.5


class CycleTimes:
    """Measures whether cycles begin on time."""

    def __init__(self) -> None:
        self._begun: float | None = None
        self._longest = 0.0
        self._late = 0

    def begin(self, now: float) -> None:
        """Note that a cycle begins at steady time `now` [s]."""
        if self._begun is not None:
            between = now - self._begun
            self._longest = max(self._longest, between)
            self._late += between > (1.0 + _LATE) * PERIOD
        self._begun = now

    def take(self) -> dict[str, str]:
        """Return the number of late cycles, and the longest cycle since the last call."""
        longest, self._longest = self._longest, 0.0
        return {"late_cycles": str(self._late), "longest_cycle_s": f"{longest:.4f}"}
