"""The parameters of drive_emulator."""

from __future__ import annotations

import dataclasses
import math

from needle_common.errors import UserError
from needle_common.parameter_fields import check_fields, parameter
from needle_sim.drives.drive_motion import LimitAction
from needle_sim.drives.drive_objects import SERVO, STEPPER
from needle_sim.drives.emulated_bus import MotionClock
from needle_sim.drives.emulated_drive import DriveSettings
from needle_sim.drives.motor import MotorSettings

# Encoder of the rotation axis: 16 bits a turn, no gear.
COUNTS_PER_RADIAN = 65536.0 / (2.0 * math.pi)
_LAST_NODE = 127


@dataclasses.dataclass(frozen=True)
class DriveEmulatorParameters:
    """Parameters of drive_emulator, fixed at start."""

    pty: str = parameter(
        "",
        unit="-",
        read_only=True,
        description="Link to the serial port that appears; empty: the port's own name is logged.",
    )
    socketcand_port: int = parameter(
        0,
        unit="-",
        lower=0,
        upper=65535,
        read_only=True,
        description="Serve TCP clients of socketcand on this port of localhost, in place of a pty.",
    )
    motion_clock: str = parameter(
        MotionClock.STEADY.value,
        unit="-",
        choices=tuple(clock.value for clock in MotionClock),
        read_only=True,
        description="steady: motors move as time goes by; sync: one SYNC period with every SYNC.",
    )
    limit_action: str = parameter(
        LimitAction.CLAMP.value,
        unit="-",
        choices=tuple(action.value for action in LimitAction),
        read_only=True,
        description="What a drive does with a target beyond 0x607D once it is homed.",
    )
    boot_time: float = parameter(
        0.5,
        unit="s",
        lower=0.0,
        upper=60.0,
        read_only=True,
        description="From power-up to the boot-up message.",
    )
    insertion_node_id: int = parameter(
        1, unit="-", lower=1, upper=_LAST_NODE, read_only=True, description="Of the stepper drive."
    )
    insertion_counts_per_unit: float = parameter(
        2.0e7,
        unit="1/m",
        lower=1.0,
        upper=1e12,
        read_only=True,
        description="Position counts of the insertion axis.",
    )
    insertion_max_speed: float = parameter(
        0.01,
        unit="m/s",
        lower=1e-6,
        upper=1.0,
        read_only=True,
        description="Fastest that the insertion motor can go.",
    )
    insertion_lag: float = parameter(
        0.0,
        unit="s",
        lower=0.0,
        upper=1.0,
        read_only=True,
        description="Time constant with which the insertion motor follows its drive.",
    )
    insertion_start: float = parameter(
        0.0,
        unit="m",
        lower=-0.003,
        upper=1.0,
        read_only=True,
        description="Where the insertion axis stands at power-up, from its home switch.",
    )
    insertion_travel: float = parameter(
        0.25,
        unit="m",
        lower=0.001,
        upper=2.0,
        read_only=True,
        description="From the home switch to the other limit switch.",
    )
    rotation_node_id: int = parameter(
        2, unit="-", lower=1, upper=_LAST_NODE, read_only=True, description="Of the servo drive."
    )
    rotation_counts_per_unit: float = parameter(
        COUNTS_PER_RADIAN,
        unit="1/rad",
        lower=1.0,
        upper=1e12,
        read_only=True,
        description="Position counts of the rotation axis.",
    )
    rotation_max_speed: float = parameter(
        20.0,
        unit="rad/s",
        lower=1e-3,
        upper=1e4,
        read_only=True,
        description="Fastest that the rotation motor can go.",
    )
    rotation_lag: float = parameter(
        0.005,
        unit="s",
        lower=0.0,
        upper=1.0,
        read_only=True,
        description="Time constant with which the rotation motor follows its drive.",
    )

    def __post_init__(self) -> None:
        """Refuse what cannot be emulated.

        Raises
        ------
        UserError
            A parameter out of bounds, two drives of one node id, two ways to the bus.
        """
        check_fields(self)
        if self.insertion_node_id == self.rotation_node_id:
            raise UserError(f"both drives have node id {self.insertion_node_id}")
        if self.pty and self.socketcand_port:
            raise UserError("give pty or socketcand_port, not both")
        if self.insertion_start > self.insertion_travel:
            raise UserError(
                f"insertion_start = {self.insertion_start:g} m is beyond insertion_travel = "
                f"{self.insertion_travel:g} m"
            )

    @property
    def insertion(self) -> DriveSettings:
        """The insertion axis: a stepper on a screw, with a limit switch at either end."""
        scale = self.insertion_counts_per_unit
        return DriveSettings(
            "insertion",
            self.insertion_node_id,
            STEPPER,
            MotorSettings(
                counts_per_unit=scale,
                max_speed=self.insertion_max_speed * scale,
                lag=self.insertion_lag,
                start=self.insertion_start * scale,
                travel=self.insertion_travel * scale,
            ),
            LimitAction(self.limit_action),
            self.boot_time,
        )

    @property
    def rotation(self) -> DriveSettings:
        """The rotation axis: a servo that turns without end."""
        scale = self.rotation_counts_per_unit
        return DriveSettings(
            "rotation",
            self.rotation_node_id,
            SERVO,
            MotorSettings(
                counts_per_unit=scale,
                max_speed=self.rotation_max_speed * scale,
                lag=self.rotation_lag,
            ),
            LimitAction(self.limit_action),
            self.boot_time,
        )
