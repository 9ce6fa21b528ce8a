"""State of an input device's controls, and the meaning of its buttons and axis."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Controls:
    """Meaning of the buttons and of one axis.

    Buttons and axis are evdev codes, or indices into a Joy message; None: not assigned.

    Attributes
    ----------
    insert : int
        Button that is held to insert.
    retract : int or None
        Button that is held to withdraw the needle.
    stop : int or None
        Button that stops.
    speed_axis : int or None
        Axis that sets the speed.
    axis_at_zero, axis_at_full : float
        Readings of the axis, -1..1, at zero and at full speed.
    """

    insert: int
    retract: int | None = None
    stop: int | None = None
    speed_axis: int | None = None
    axis_at_zero: float = -1.0
    axis_at_full: float = 1.0

    @property
    def buttons(self) -> tuple[int, ...]:
        """All assigned buttons."""
        named = (self.insert, self.retract, self.stop)
        return tuple(button for button in named if button is not None)

    def speed(self, axis: float) -> float:
        """Return the share of the speed, 0..1, for a reading of the axis."""
        share = (axis - self.axis_at_zero) / (self.axis_at_full - self.axis_at_zero)
        return min(max(share, 0.0), 1.0)


@dataclasses.dataclass(frozen=True)
class InputState:
    """State of the controls at one moment.

    Attributes
    ----------
    insert, retract, stop : bool
        Whether the button is down.
    speed : float
        Requested share of the nominal speed, 0..1.
    """

    insert: bool = False
    retract: bool = False
    stop: bool = False
    speed: float = 1.0

    @property
    def is_neutral(self) -> bool:
        """Whether no button is down."""
        return not (self.insert or self.retract or self.stop)


@dataclasses.dataclass(frozen=True)
class InputLost:
    """The input device is unavailable.

    Attributes
    ----------
    reason : str
        Why.
    """

    reason: str


InputReading = InputState | InputLost
