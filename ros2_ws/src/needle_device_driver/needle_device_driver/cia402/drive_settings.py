"""Settings of one CiA 402 drive, beside those of its axis."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from needle_core.errors import UserError
from needle_core.settings.bounds import Bounds
from needle_device_driver.axes.axis_settings import HERE, AxisSettings, Positive
from needle_device_driver.link import objects as od

# Homing methods with an index pulse, and to a switch.
INDEX_PULSE = (*range(1, 15), 33, 34)
SWITCHES = tuple(range(1, 15)) + tuple(range(17, 31))
HOMING_METHODS = (*SWITCHES, 33, 34, *HERE)


@dataclasses.dataclass(frozen=True, kw_only=True)
class DriveSettings(AxisSettings):
    """Settings of an axis' drive.

    Attributes
    ----------
    node_id : int
        CANopen node id, 1..126.
    following_error_time : float
        Time for which the drive tolerates a greater following error [s].
    max_torque : float
        Share of the rated torque; 0: the drive's own setting.
    counts_per_turn : float
        Position counts per turn of the drive's shaft; 0: as the drive reports, or unknown.
    speed_unit, ramp_unit : float
        The drive's unit of speed [counts/s] and of ramps [counts/s^2].
    """

    node_id: Annotated[int, Bounds(1, 126, "-")]
    following_error_time: Positive
    max_torque: float
    counts_per_turn: float = 0.0
    speed_unit: float = 1.0
    ramp_unit: float = 1.0

    def __post_init__(self) -> None:
        """Check the settings.

        Raises
        ------
        UserError
            A value out of bounds, or an unknown homing method.
        """
        super().__post_init__()
        if self.homing_method not in HOMING_METHODS:
            raise UserError(f"homing_method = {self.homing_method} is not a CiA 402 method")

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
