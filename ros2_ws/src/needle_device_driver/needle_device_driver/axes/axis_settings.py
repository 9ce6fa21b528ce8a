"""Settings of one axis in SI units, and their conversion to the counts of its drive."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from needle_core.errors import OutOfBoundsError
from needle_core.settings.bounds import ABOVE_0, Bounds, check_bounded_fields

Positive = Annotated[float, Bounds(ABOVE_0, math.inf, "SI")]
HERE = (35, 37)
"""Homing methods of CiA 402 that set the home where the axis stands."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisSettings:
    """Settings of an axis that every kind of drive has; lengths in m or rad.

    Attributes
    ----------
    counts_per_unit : float
        Position counts per metre or radian.
    reverse : bool
        Whether the counts decrease in the positive direction.
    speed, acceleration, quick_stop_deceleration : float
        Greatest speed [unit/s]; ramps [unit/s^2].
    homing_method : int
        By its number in CiA 402; 37: the home is where the axis stands.
    following_error : float
        Bound of the distance from the set-point.
    lower, upper : float
        Software limits, from home.
    tolerance : float
        An axis stands still in a cycle if it moves no farther.
    unit : str
        Of the axis: m or rad.
    travel : float
        Greatest distance from home.
    actuated : bool
        Whether the drive has a motor; otherwise a hand moves the axis.
    """

    counts_per_unit: Positive
    reverse: bool
    speed: Positive
    acceleration: Positive
    quick_stop_deceleration: Positive
    homing_method: int
    following_error: Positive
    lower: float
    upper: float
    tolerance: Positive
    unit: str = "m"
    travel: float = math.inf
    actuated: bool = True

    def __post_init__(self) -> None:
        """Check the settings.

        Raises
        ------
        UserError
            A value out of bounds.
        """
        check_bounded_fields(self)
        if not self.lower < self.upper:
            raise OutOfBoundsError("lower", self.lower, -math.inf, self.upper, "SI")

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
        """Return a distance for messages."""
        return f"{value * 1e3:.4g} mm" if self.unit == "m" else f"{value:.4g} rad"

    @property
    def longest_search(self) -> float:
        """Farthest that homing searches for the switch: a fifth beyond the travel."""
        return 1.2 * self.travel

    @property
    def stop_time(self) -> float:
        """Longest time of a quick stop [s]: a drive may round its ramp down to half."""
        return 2.0 * self.speed / self.quick_stop_deceleration

    @property
    def limits(self) -> str:
        """Software limits as messages have them."""
        return f"limits [{self.lower:.6g}, {self.upper:.6g}]"

    @property
    def limits_counts(self) -> tuple[int, int]:
        """Software limits in counts, lower first."""
        limits = sorted((self.counts(self.lower), self.counts(self.upper)))
        return limits[0], limits[1]
