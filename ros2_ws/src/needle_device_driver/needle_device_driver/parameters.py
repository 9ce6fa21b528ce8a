"""Parameters of device_driver."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link.link_settings import LinkSettings
from needle_device_driver.supervisor.limits import SafetyLimits, limit_parameter

# A drive's software limits exceed the supervisor's limits by this factor times the following error.
_LIMIT_MARGIN = 2.0
# Longest time that a drive with a motor may run without the computer's heartbeat [s].
LONGEST_WATCHDOG = 0.5


@dataclasses.dataclass(frozen=True)
class DriverParameters(SafetyLimits, LinkSettings):
    """Parameters of device_driver other than those of one drive."""

    connect_timeout: float = fixed_parameter(
        10.0, "s", "Maximum wait for adapter and drives at start.", 0.0, 3600.0
    )
    insertion_drive: str = fixed_parameter(
        "motor",
        "-",
        "motor; or hand: a person pushes the needle, the insertion drive only measures its "
        "position, and the rotation follows it.",
        choices=("motor", "hand"),
    )
    watchdog: float = fixed_parameter(
        0.1,
        "s",
        "A drive stops if it receives no heartbeat of the computer for this time.",
        0.05,
        LONGEST_WATCHDOG,
    )

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises
        ------
        UserError
            A parameter out of bounds, an invalid link, or two drives with one node id.
        """
        LinkSettings.__post_init__(self)
        if self.drive("insertion").node_id == self.drive("rotation").node_id:
            raise UserError("insertion_node_id and rotation_node_id are the same")

    @property
    def write_timeout(self) -> float:
        """Longest wait of a frame for the adapter [s].

        It is shorter than `reply_age_limit`, so that a stuck adapter is reported as a lost link,
        and not as silent drives.
        """
        return self.reply_age_limit / 2.0

    def drive(self, axis: str) -> DriveSettings:
        """Return the settings of the `insertion` or `rotation` drive."""
        names = {field.name for field in dataclasses.fields(DriveSettings)}
        own = {name: getattr(self, f"{axis}_{name}", None) for name in names}
        values = {name: value for name, value in own.items() if value is not None}
        margin = _LIMIT_MARGIN * values["following_error"]
        if axis == "insertion":
            values["actuated"] = self.insertion_drive == "motor"
            values |= {"speed": self.max_speed, "travel": self.max_depth, "lower": -margin}
        else:
            values |= {"speed": self.max_rotation_rate, "travel": self.max_rotation}
            values |= {"unit": "rad", "lower": -self.max_rotation - margin}
        values["upper"] = values["travel"] + margin
        return DriveSettings(**values)


def _axis(
    axis: str,
    unit: str,
    *,
    node_id: int,
    counts_per_unit: float,
    acceleration: float,
    quick_stop: float,
    homing_method: int,
    tolerance: float,
) -> list[tuple[str, type, Any]]:
    ramp = f"{unit}/s^2"
    fields = {
        "node_id": fixed_parameter(node_id, "-", "CANopen node id of the drive.", 1, 126),
        "counts_per_unit": fixed_parameter(
            counts_per_unit, f"counts/{unit}", "Position counts per unit of the axis.", 1.0, 1e12
        ),
        "counts_per_turn": fixed_parameter(
            0.0, "counts", "Counts per turn of a drive in rpm; 0: as it reports (0x608F).", 0.0, 1e9
        ),
        "reverse": fixed_parameter(False, "-", "The drive counts in the opposite direction."),
        "acceleration": fixed_parameter(acceleration, ramp, "Ramp of homing.", 1e-4, 1e4),
        "quick_stop_deceleration": fixed_parameter(
            quick_stop, ramp, "Deceleration of a quick stop.", 1e-4, 1e4
        ),
        "homing_method": fixed_parameter(
            homing_method, "-", "CiA 402 method: 17, 18 limit switch; 37 current position.", 1, 37
        ),
        "following_error": limit_parameter(f"{axis}_following_error"),
        "following_error_time": fixed_parameter(
            0.05, "s", "Time for which the drive tolerates a larger following error.", 0.001, 10.0
        ),
        "max_torque": fixed_parameter(
            0.0, "-", "Maximum share of the rated torque; 0: the drive's setting.", 0.0, 5.0
        ),
        "tolerance": fixed_parameter(
            tolerance, unit, "Position tolerance at the target.", 1e-7, 1.0
        ),
    }
    return [(f"{axis}_{name}", type(f.default), f) for name, f in fields.items()]


DeviceDriverParameters: type[DriverParameters] = dataclasses.make_dataclass(
    "DeviceDriverParameters",
    [
        # A lead screw of 1 mm, 20000 counts per turn.
        *_axis(
            "insertion",
            "m",
            node_id=1,
            counts_per_unit=20_000_000.0,
            acceleration=0.05,
            quick_stop=0.5,
            homing_method=17,
            tolerance=5e-6,
        ),
        # An encoder of 16384 lines, four counts per line, on the needle's own shaft.
        *_axis(
            "rotation",
            "rad",
            node_id=2,
            counts_per_unit=65536.0 / (2.0 * math.pi),
            acceleration=20.0,
            quick_stop=100.0,
            homing_method=37,
            tolerance=1e-3,
        ),
    ],
    bases=(DriverParameters,),
    frozen=True,
)
DeviceDriverParameters.__doc__ = "Parameters of device_driver, fixed at start."
