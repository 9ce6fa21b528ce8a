"""Settings of one drive in SI units, and their conversion to counts."""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated

from needle_core.errors import OutOfBoundsError, UserError
from needle_core.settings.bounds import ABOVE_0, Bounds, check_bounded_fields
from needle_device_driver.link import objects as od

# Homing methods of CiA 402: where the axis stands, with an index pulse, to a switch.
HERE = (35, 37)
INDEX_PULSE = (*range(1, 15), 33, 34)
SWITCHES = tuple(range(1, 15)) + tuple(range(17, 31))
HOMING_METHODS = (*SWITCHES, 33, 34, *HERE)
_Positive = Annotated[float, Bounds(ABOVE_0, math.inf, "SI")]


@dataclasses.dataclass(frozen=True)
class DriveSettings:
    """Settings of an axis' drive; lengths in m or rad.

    Attributes
    ----------
    node_id : int
        CANopen node id, 1..126.
    counts_per_unit : float
        Position counts per metre or radian.
    reverse : bool
        Whether the counts decrease in the positive direction.
    speed, acceleration, quick_stop_deceleration : float
        Greatest speed [unit/s]; ramps [unit/s^2].
    homing_method : int
        CiA 402 homing method.
    following_error : float
        Bound in the drive.
    following_error_time : float
        Time for which the drive tolerates a greater one [s].
    max_torque : float
        Share of the rated torque; 0: the drive's own setting.
    lower, upper : float
        Software limits in the drive, from home.
    tolerance : float
        An axis stands still in a cycle if it moves no farther.
    unit : str
        Of the axis: m or rad.
    travel : float
        Greatest distance from home; homing searches a fifth farther.
    counts_per_turn : float
        Position counts per turn of the drive's shaft; 0: as the drive reports, or unknown.
    speed_unit, ramp_unit : float
        The drive's unit of speed [counts/s] and of ramps [counts/s^2].
    actuated : bool
        Whether the drive has a motor; otherwise a hand moves the axis.
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
        """Check the settings.

        Raises
        ------
        UserError
            A value out of bounds, or an unknown homing method.
        """
        check_bounded_fields(self)
        if self.homing_method not in HOMING_METHODS:
            raise UserError(f"homing_method = {self.homing_method} is not a CiA 402 method")
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

    @property
    def outer_switches(self) -> int:
        """Bits of the digital inputs that end an outward motion."""
        # If the drive counts in reverse, outward is its positive direction.
        limit = od.POSITIVE_LIMIT_SWITCH if self.reverse else od.NEGATIVE_LIMIT_SWITCH
        return limit | od.HOME_SWITCH

    @property
    def inner_switch(self) -> int:
        """Bit of the digital inputs that ends an inward motion."""
        return od.NEGATIVE_LIMIT_SWITCH if self.reverse else od.POSITIVE_LIMIT_SWITCH
