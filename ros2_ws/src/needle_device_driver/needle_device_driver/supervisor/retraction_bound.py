"""Bound on drawing the needle out where no home position says how deep it is."""

from __future__ import annotations

from needle_device_driver.axes.axis import AxisSnapshot


class RetractionBound:
    """Remembers the last known depth across the loss of the home position.

    Parameters
    ----------
    max_depth : float
        The way out when no depth was ever known [m].
    """

    def __init__(self, max_depth: float) -> None:
        self._remaining = max_depth
        self._before: AxisSnapshot | None = None

    def note(self, insertion: AxisSnapshot) -> None:
        """Take each snapshot of the insertion axis."""
        before, self._before = self._before, insertion
        if insertion.homed or before is None:
            return
        if before.homed:
            self._remaining = max(before.position, 0.0)
        elif before.origin == insertion.origin:
            self._remaining += insertion.position - before.position

    def target(self, insertion: AxisSnapshot) -> float:
        """Return where a retraction ends at the latest, in the axis' present count [m]."""
        return 0.0 if insertion.homed else insertion.position - self._remaining
