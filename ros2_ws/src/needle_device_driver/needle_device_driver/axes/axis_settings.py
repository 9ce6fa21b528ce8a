"""Settings of one axis in SI units, and their conversion to the counts of its drive."""

from __future__ import annotations

import dataclasses
import math

PRESENT_POSITION_METHODS = (35, 37)
"""CiA 402 homing methods that define the present position as home."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisSettings:
    """Axis settings common to all kinds of drives, from checked parameters; lengths in m or rad.

    Derived from checked parameters.

    Attributes
    ----------
    counts_per_unit : float
        Position counts per metre or radian.
    reverse : bool
        Whether the counts decrease in the positive direction.
    speed, acceleration, quick_stop_deceleration : float
        Greatest speed [unit/s]; ramps [unit/s^2].
    homing_method : int
        CiA 402 number of the homing method; 37: the present position becomes home.
    following_error : float
        Largest allowed distance from the set-point.
    lower, upper : float
        Software limits, from home.
    tolerance : float
        Largest motion per cycle of an axis at rest.
    unit : str
        Unit of the axis: m or rad.
    travel : float
        Greatest distance from home.
    actuated : bool
        Whether the drive has a motor; otherwise the axis is moved by hand.
    """

    counts_per_unit: float
    reverse: bool
    speed: float
    acceleration: float
    quick_stop_deceleration: float
    homing_method: int
    following_error: float
    lower: float
    upper: float
    tolerance: float
    unit: str = "m"
    travel: float = math.inf
    actuated: bool = True

    @property
    def direction(self) -> int:
        """1, or -1 if the drive counts in reverse."""
        return -1 if self.reverse else 1

    def counts(self, position: float) -> int:
        """Return the count nearest to a position [m or rad]."""
        return self.direction * round(position * self.counts_per_unit)

    def position(self, counts: int) -> float:
        """Return the position of a count [m or rad]."""
        return self.direction * counts / self.counts_per_unit

    def magnitude(self, value: float, unit: float = 1.0) -> int:
        """Return a distance, speed or ramp in counts, or in units of `unit` counts.

        It is at least 1: in a drive, 0 often means "no limit".
        """
        return max(1, round(value * self.counts_per_unit / unit))

    def text(self, value: float) -> str:
        """Format a distance for messages."""
        return f"{value * 1e3:.4g} mm" if self.unit == "m" else f"{value:.4g} rad"

    @property
    def longest_search(self) -> float:
        """Longest search for the home switch: 20 % more than the travel."""
        return 1.2 * self.travel

    @property
    def stop_time(self) -> float:
        """Longest time of a quick stop [s]: a drive may round its ramp down to half."""
        return 2.0 * self.speed / self.quick_stop_deceleration

    @property
    def limits(self) -> str:
        """Software limits, formatted for messages."""
        return f"limits [{self.lower:.6g}, {self.upper:.6g}]"

    @property
    def limits_counts(self) -> tuple[int, int]:
        """Software limits in counts, lower first."""
        limits = sorted((self.counts(self.lower), self.counts(self.upper)))
        return limits[0], limits[1]
