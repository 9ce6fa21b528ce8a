"""The parameters of device_driver."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link.link_settings import LINKS, LinkSettings
from needle_device_driver.supervisor.limits import (
    SafetyLimits,
    limit_parameter,
)

# Beyond the supervisor's own limits, a drive's limits leave room for its following error.
_LIMIT_MARGIN = 2.0
# The longest that drives whose motors turn by themselves may go unheard [s].
LONGEST_WATCHDOG = 0.5


@dataclasses.dataclass(frozen=True)
class DriverParameters:
    """Parameters of device_driver that are not one drive's."""

    link: str = fixed_parameter(
        "slcan",
        "-",
        "slcan: serial adapter or pseudo-terminal; socketcan: Linux CAN interface; socketcand: one "
        "over TCP; virtual: inside one process.",
        choices=LINKS,
    )
    channel: str = fixed_parameter(
        "/dev/ttyACM0", "-", "Device file (slcan) or name of the interface."
    )
    bitrate: int = fixed_parameter(
        500_000, "bit/s", "Of the CAN bus; slcan only.", 10_000, 1_000_000
    )
    tty_baudrate: int = fixed_parameter(
        115_200, "bit/s", "Of the serial port; slcan only, USB adapters ignore it.", 9600, 4_000_000
    )
    host: str = fixed_parameter("localhost", "-", "Where socketcand runs.")
    port: int = fixed_parameter(29536, "-", "Where socketcand listens.", 1, 65535)
    connect_timeout: float = fixed_parameter(
        10.0, "s", "How long adapter and drives may take to be there.", 0.0, 3600.0
    )
    insertion_drive: str = fixed_parameter(
        "motor",
        "-",
        "motor; or hand: a person pushes the needle, the insertion drive only says where it is, "
        "and the rotation follows.",
        choices=("motor", "hand"),
    )
    watchdog: float = fixed_parameter(
        0.1,
        "s",
        "A drive stops without the computer's heartbeat for so long.",
        0.05,
        LONGEST_WATCHDOG,
    )
    reply_age_limit: float = limit_parameter("reply_age_limit")
    hold_timeout: float = limit_parameter("hold_timeout")
    tip_age_limit: float = limit_parameter("tip_age_limit")
    max_depth: float = limit_parameter("max_depth")
    max_step_length: float = limit_parameter("max_step_length")
    max_speed: float = limit_parameter("max_speed")
    max_rotation_step: float = limit_parameter("max_rotation_step")
    max_rotation_rate: float = limit_parameter("max_rotation_rate")
    max_turns: float = limit_parameter("max_turns")
    retraction_speed: float = limit_parameter("retraction_speed")
    homing_speed: float = limit_parameter("homing_speed")
    homing_rotation_rate: float = limit_parameter("homing_rotation_rate")
    settling_time: float = limit_parameter("settling_time")

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises
        ------
        UserError
            A parameter out of bounds, two drives with one node id, or a link that is none.
        """
        check_fields(self)
        if self.drive("insertion").node_id == self.drive("rotation").node_id:
            raise UserError("insertion_node_id and rotation_node_id are the same")
        _ = self.link_settings, self.limits

    @property
    def link_settings(self) -> LinkSettings:
        """The CAN link."""
        return LinkSettings(
            kind=self.link,
            channel=self.channel,
            bitrate=self.bitrate,
            tty_baudrate=self.tty_baudrate,
            host=self.host,
            port=self.port,
            # Before a drive would count as silent, its link has a name.
            write_timeout=self.reply_age_limit / 2.0,
        )

    @property
    def limits(self) -> SafetyLimits:
        """The motion supervisor's limits."""
        return SafetyLimits.of(self)

    def drive(self, axis: str) -> DriveSettings:
        """Return the settings of the `insertion` or `rotation` drive."""
        limits = self.limits
        names = {field.name for field in dataclasses.fields(DriveSettings)}
        own = {name: getattr(self, f"{axis}_{name}", None) for name in names}
        values = {name: value for name, value in own.items() if value is not None}
        margin = _LIMIT_MARGIN * values["following_error"]
        if axis == "insertion":
            values["actuated"] = self.insertion_drive == "motor"
            values |= {"speed": limits.max_speed, "travel": limits.max_depth, "lower": -margin}
        else:
            values |= {"speed": limits.max_rotation_rate, "travel": limits.max_rotation}
            values |= {"unit": "rad", "lower": -limits.max_rotation - margin}
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
            counts_per_unit, f"counts/{unit}", "Position counts of the drive.", 1.0, 1e12
        ),
        "counts_per_turn": fixed_parameter(
            0.0, "counts", "In a turn, of a drive in rpm; 0: as it says (0x608F).", 0.0, 1e9
        ),
        "reverse": fixed_parameter(False, "-", "Whether the drive counts the other way."),
        "acceleration": fixed_parameter(acceleration, ramp, "Ramp of homing.", 1e-4, 1e4),
        "quick_stop_deceleration": fixed_parameter(quick_stop, ramp, "Ramp of a stop.", 1e-4, 1e4),
        "homing_method": fixed_parameter(
            homing_method, "-", "CiA 402 method: 17, 18 limit switch; 37 where it stands.", 1, 37
        ),
        "following_error": limit_parameter(f"{axis}_following_error"),
        "following_error_time": fixed_parameter(
            0.05, "s", "How long the drive itself lets that be exceeded.", 0.001, 10.0
        ),
        "max_torque": fixed_parameter(
            0.0, "-", "Share of rated torque; 0: as the drive has it.", 0.0, 5.0
        ),
        "tolerance": fixed_parameter(tolerance, unit, "An axis so close has arrived.", 1e-7, 1.0),
    }
    return [(f"{axis}_{name}", type(f.default), f) for name, f in fields.items()]


DeviceDriverParameters: type[DriverParameters] = dataclasses.make_dataclass(
    "DeviceDriverParameters",
    [
        # A lead screw of 1 mm, 20000 counts a turn.
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
        # An encoder of 16384 lines, four counts a line, on the needle's own shaft.
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
