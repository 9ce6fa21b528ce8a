"""Parameters of device_driver."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from needle_core.component import RealPort
from needle_core.settings.parameter_fields import check_fields, fixed_parameter, from_values
from needle_core.settings.parameter_files import read_parameters
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.backend import HAND, Backend, backends, parameters_of
from needle_device_driver.supervisor.limits import SafetyLimits, limit_parameter

# A drive's software limits exceed the supervisor's limits by this factor times the following error.
_LIMIT_MARGIN = 2.0
# Longest time that a drive with a motor may run without the computer's heartbeat [s].
LONGEST_WATCHDOG = 0.5
BACKENDS = backends()
"""All installed kinds of drives by name."""
AXES = ("insertion", "rotation")


def _axis(axis: str, unit: str, *defaults: float) -> dict[str, Any]:
    scale, acceleration, stop, home, tolerance = defaults
    ramp = f"{unit}/s^2"
    fields = {
        "counts_per_unit": fixed_parameter(
            scale, f"counts/{unit}", "Position counts per unit of the axis.", 1.0, 1e12
        ),
        "reverse": fixed_parameter(False, "-", "The drive counts in the opposite direction."),
        "acceleration": fixed_parameter(acceleration, ramp, "Ramp of homing.", 1e-4, 1e4),
        "quick_stop_deceleration": fixed_parameter(
            stop, ramp, "Deceleration of a quick stop.", 1e-4, 1e4
        ),
        "homing_method": fixed_parameter(
            int(home), "-", "CiA 402 method: 17, 18 limit switch; 37 current position.", 1, 37
        ),
        "following_error": limit_parameter(f"{axis}_following_error"),
        "tolerance": fixed_parameter(
            tolerance, unit, "Position tolerance at the target.", 1e-7, 1.0
        ),
    }
    return {f"{axis}_{name}": field for name, field in fields.items()}


# Counts, ramps, homing method, tolerance. Insertion: a lead screw of 1 mm, 20000 counts per turn.
# Rotation: an encoder of 16384 lines, four counts per line, on the needle's own shaft.
_AXIS_FIELDS = {
    **_axis("insertion", "m", 20_000_000.0, 0.05, 0.5, 17, 5e-6),
    **_axis("rotation", "rad", 65536.0 / (2.0 * math.pi), 20.0, 100.0, 37, 1e-3),
}
_OF_AXIS = tuple(name.removeprefix("insertion_") for name in _AXIS_FIELDS if "insertion_" in name)


@dataclasses.dataclass(frozen=True)
class DriverParameters(SafetyLimits):
    """Parameters of device_driver other than those of one axis or one kind of drive."""

    connect_timeout: float = fixed_parameter(
        10.0, "s", "Maximum wait for the drives' connection at start.", 0.0, 3600.0
    )
    insertion_drive: str = fixed_parameter(
        "cia402",
        "-",
        "Kind of the insertion drive; hand: a person pushes the needle, a CiA 402 drive only "
        "measures its position, and the rotation follows it.",
        choices=tuple(BACKENDS),
    )
    rotation_drive: str = fixed_parameter(
        "cia402",
        "-",
        "Kind of the rotation drive.",
        choices=tuple(name for name in BACKENDS if name != HAND),
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
            If a parameter is out of bounds, or parameters of a drive contradict each other.
        """
        check_fields(self)
        for backend in self.backends:
            backend.check(self)

    @property
    def backends(self) -> tuple[Backend, ...]:
        """The kinds of drives in use, each once."""
        return tuple(dict.fromkeys(BACKENDS[getattr(self, f"{axis}_drive")] for axis in AXES))

    @property
    def write_timeout(self) -> float:
        """Longest wait of a frame for the adapter [s].

        It is shorter than `reply_age_limit`, so that a stuck adapter is reported as a lost link,
        and not as silent drives.
        """
        return self.reply_age_limit / 2.0

    def ports(self) -> dict[str, RealPort]:
        """Return the ports to the drives by name."""
        return {backend.port: backend.open_port(self) for backend in self.backends}

    def axes_of(self, backend: Backend) -> dict[str, AxisSettings]:
        """Return the settings of the axes with this kind of drive."""
        return {
            axis: self.axis(axis)
            for axis in AXES
            if BACKENDS[getattr(self, f"{axis}_drive")] is backend
        }

    def axis(self, axis: str) -> AxisSettings:
        """Return the settings of the `insertion` or `rotation` axis."""
        values = {name: getattr(self, f"{axis}_{name}") for name in _OF_AXIS}
        margin = _LIMIT_MARGIN * values["following_error"]
        if axis == "insertion":
            values["actuated"] = self.insertion_drive != HAND
            values |= {"speed": self.max_speed, "travel": self.max_depth, "lower": -margin}
        else:
            values |= {"speed": self.max_rotation_rate, "travel": self.max_rotation}
            values |= {"unit": "rad", "lower": -self.max_rotation - margin}
        values["upper"] = values["travel"] + margin
        return AxisSettings(**values)


if TYPE_CHECKING:
    DeviceDriverParameters: Any
else:
    DeviceDriverParameters = dataclasses.make_dataclass(
        "DeviceDriverParameters",
        [(name, type(field.default), field) for name, field in _AXIS_FIELDS.items()],
        bases=(DriverParameters, *parameters_of(BACKENDS.values())),
        frozen=True,
    )
    DeviceDriverParameters.__doc__ = "Parameters of device_driver, fixed at start."


def read_driver_parameters(path: Path) -> Any:
    """Return the parameters of device_driver from a parameter file; raises `UserError`."""
    values = read_parameters(path, ["device_driver"]).get("device_driver", {})
    return from_values(DeviceDriverParameters, values, "device_driver")
