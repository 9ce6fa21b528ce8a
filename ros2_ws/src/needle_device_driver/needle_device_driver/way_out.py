"""How far the needle may be drawn out, also when its depth is no longer known."""

from __future__ import annotations

from needle_device_driver.axis import AxisSnapshot


class WayOut:
    """Remembers the last known depth across the loss of the home position.

    Parameters
    ----------
    max_depth : float
        The way out when no depth was ever known [m].
    """

    def __init__(self, max_depth: float) -> None:
        self._max_depth = max_depth
        self._before: AxisSnapshot | None = None
        self._unhomed_target: float | None = None

    def note(self, insertion: AxisSnapshot) -> None:
        """Take each snapshot of the insertion axis."""
        if insertion.homed:
            self._unhomed_target = None
        elif self._before is not None and self._before.homed:
            # The way is as long as the needle was deep, in whatever the axis counts now.
            self._unhomed_target = insertion.position - max(self._before.position, 0.0)
        self._before = insertion

    def target(self, insertion: AxisSnapshot) -> float:
        """Return where a retraction ends at the latest, in the axis' present count [m]."""
        if insertion.homed:
            return 0.0
        if self._unhomed_target is not None:
            return self._unhomed_target
        return insertion.position - self._max_depth
