"""Steady time that counts only while a process looks."""

from __future__ import annotations

# More than a timer of a node on a busy machine is late [s].
LONGEST_LOOK = 0.5


class WatchedTime:
    """Steady time without what its reader slept through.

    A process that was stopped or starved has not waited: what it waits for may have come meanwhile
    and not be heard yet.
    """

    def __init__(self) -> None:
        self._read_at: float | None = None
        self._time = 0.0

    def read(self, steady: float) -> float:
        """Return the watched time [s] at steady time `steady` [s]."""
        if self._read_at is not None:
            self._time += min(steady - self._read_at, LONGEST_LOOK)
        self._read_at = steady
        return self._time
