"""One drive's settings in SI, and how they become counts."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from needle_core.errors import OutOfBoundsError, UserError
from needle_core.settings.bounds import ABOVE_0, Bounds, check_bounded_fields
from needle_device_driver.link import objects as od

# Methods of CiA 402: to a limit switch or a home switch, or where the axis stands.
HERE = (35, 37)
INDEX_PULSE = (*range(1, 15), 33, 34)
SWITCHES = tuple(range(1, 15)) + tuple(range(17, 31))
HOMING_METHODS = (*SWITCHES, 33, 34, *HERE)
_Positive = Annotated[float, Bounds(ABOVE_0, math.inf, "SI")]


@dataclasses.dataclass(frozen=True)
class DriveSettings:
    """One axis' drive; lengths in m or rad.

    Attributes
    ----------
    node_id : int
        CANopen node id, 1..126.
    counts_per_unit : float
        Position counts a metre or radian, not negative.
    reverse : bool
        Whether positive counts are the negative direction.
    speed, acceleration, quick_stop_deceleration : float
        Fastest motion [unit/s]; ramps [unit/s^2].
    homing_method : int
        CiA 402 homing method.
    following_error : float
        The drive's own bound.
    following_error_time : float
        How long the drive lets it be exceeded [s].
    max_torque : float
        Share of the rated torque; 0: as the drive has it.
    lower, upper : float
        Software limits in the drive, from home.
    tolerance : float
        An axis that moves less in a cycle stands still.
    unit : str
        Of the axis: m or rad.
    travel : float
        How far from its home the axis may be; homing searches so far and a fifth more.
    counts_per_turn : float
        Position counts in a turn of the drive's shaft; 0: as it says, or not known.
    speed_unit, ramp_unit : float
        Counts/s in one of the drive's units of speed, counts/s^2 in one of its ramps.
    actuated : bool
        False: a hand moves it, the drive only says where it is.
    """

    node_id: Annotated[int, Bounds(1, 126, "-")]
    counts_per_unit: _Positive
    reverse: bool
    speed: _Positive
    acceleration: _Positive
    quick_stop_deceleration: _Positive
    homing_method: int
    following_error: _Positive
    following_error_time: _Positive
    max_torque: float
    lower: float
    upper: float
    tolerance: _Positive
    unit: str = "m"
    travel: float = math.inf
    counts_per_turn: float = 0.0
    speed_unit: float = 1.0
    ramp_unit: float = 1.0
    actuated: bool = True

    def __post_init__(self) -> None:
        """Refuse what no drive can be set to.

        Raises
        ------
        UserError
            A value that is not finite, not positive where it must be, or no homing method.
        """
        check_bounded_fields(self)
        if self.homing_method not in HOMING_METHODS:
            raise UserError(f"homing_method = {self.homing_method} is none of CiA 402's")
        if not self.lower < self.upper:
            raise OutOfBoundsError("lower", self.lower, -math.inf, self.upper, "SI")

    @property
    def direction(self) -> int:
        """1, or -1 where the drive counts the other way."""
        return -1 if self.reverse else 1

    def counts(self, position: float) -> int:
        """Return the nearest count to a position; positions are absolute, so rounding stays."""
        return self.direction * round(position * self.counts_per_unit)

    def position(self, counts: int) -> float:
        """Return the position of a count [m or rad]."""
        return self.direction * counts / self.counts_per_unit

    def magnitude(self, value: float, unit: float = 1.0) -> int:
        """Return a distance, speed or ramp in counts, or in units of so many counts.

        It is at least 1: 0 often means "no limit".
        """
        return max(1, round(value * self.counts_per_unit / unit))

    def told(self, value: float) -> str:
        """Return a position as messages have it."""
        return f"{value * 1e3:.4g} mm" if self.unit == "m" else f"{value:.4g} rad"

    @property
    def stop_time(self) -> float:
        """Longest time of a quick stop [s]; a drive may round its ramp down to half."""
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

    @property
    def outer_switches(self) -> int:
        """Bits of the digital inputs that end the way out."""
        # Outward is the drive's positive direction where it counts in reverse.
        limit = od.POSITIVE_LIMIT_SWITCH if self.reverse else od.NEGATIVE_LIMIT_SWITCH
        return limit | od.HOME_SWITCH

    @property
    def inner_switch(self) -> int:
        """Bit of the digital inputs that ends the way in."""
        return od.NEGATIVE_LIMIT_SWITCH if self.reverse else od.POSITIVE_LIMIT_SWITCH
