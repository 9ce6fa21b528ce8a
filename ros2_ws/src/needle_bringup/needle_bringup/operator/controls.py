"""Which of a source's buttons and axes mean what."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Controls:
    """Meaning of a source's buttons, and of one axis.

    Buttons and axis are evdev's codes, or indices into a Joy message; None: there is none.

    Attributes
    ----------
    insert : int
        Button that is held to insert.
    retract : int or None
        Button that is held to draw the needle out.
    stop : int or None
        Button that stops.
    speed_axis : int or None
        Axis that sets the speed.
    axis_at_zero, axis_at_full : float
        What the axis reads, of -1..1, where it asks for no speed and for all of it.
    """

    insert: int
    retract: int | None = None
    stop: int | None = None
    speed_axis: int | None = None
    axis_at_zero: float = -1.0
    axis_at_full: float = 1.0

    @property
    def buttons(self) -> tuple[int, ...]:
        """Every button that means something."""
        named = (self.insert, self.retract, self.stop)
        return tuple(button for button in named if button is not None)

    def speed(self, axis: float) -> float:
        """Return the share of the speed that a reading of the axis asks for, 0..1."""
        share = (axis - self.axis_at_zero) / (self.axis_at_full - self.axis_at_zero)
        return min(max(share, 0.0), 1.0)
