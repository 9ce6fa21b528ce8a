"""The operator's parameters."""

from __future__ import annotations

import dataclasses

from needle_core.errors import UserError
from needle_core.settings.parameter_fields import check_fields, fixed_parameter, parameter

PERIOD = 0.02
"""Period of reading the controls [s]."""
PEDAL, JOYSTICK, JOY = "pedal", "joystick", "joy"
NONE = -1
"""Value of a key or axis that is not assigned."""
_LAST_KEY, _LAST_AXIS = 0x2FF, 0x3F


@dataclasses.dataclass(frozen=True)
class OperatorParameters:
    """Parameters of the operator; SI units."""

    source: str = fixed_parameter(
        PEDAL,
        "-",
        "Input: event device of a pedal (or key) or of a joystick; or the topic joy.",
        choices=(PEDAL, JOYSTICK, JOY),
    )
    device: str = fixed_parameter(
        "", "-", "Event device of the pedal or joystick, preferably from /dev/input/by-id."
    )
    key: int = fixed_parameter(
        NONE,
        "-",
        "Key or button held to insert: its code as shown by evtest, or its index in joy.",
        NONE,
        _LAST_KEY,
    )
    retract_key: int = fixed_parameter(
        NONE, "-", "Key or button held to retract; -1: none.", NONE, _LAST_KEY
    )
    stop_key: int = fixed_parameter(NONE, "-", "Pressed to stop; -1: none.", NONE, _LAST_KEY)
    speed_axis: int = fixed_parameter(
        NONE,
        "-",
        "Joystick axis, or axis index in joy, that sets the speed; -1: none.",
        NONE,
        _LAST_AXIS,
    )
    axis_at_zero: float = fixed_parameter(
        -1.0, "-", "Reading of the axis at zero speed, from -1 to 1.", -1.0, 1.0
    )
    axis_at_full: float = fixed_parameter(
        1.0, "-", "Reading of the axis at full speed, from -1 to 1.", -1.0, 1.0
    )
    speed_scale: float = parameter(
        1.0,
        unit="-",
        lower=0.0,
        upper=1.0,
        description="Speed relative to the nominal speed; with speed_axis, at the full reading.",
    )

    def __post_init__(self) -> None:
        """Check the fields.

        Raises
        ------
        UserError
            If a field is out of bounds, is missing, or contradicts another.
        """
        check_fields(self)
        if self.key == NONE:
            raise UserError("key = -1: name what is held to insert (evtest shows codes)")
        if self.source != JOY and not self.device:
            raise UserError(
                f"device = '': name the {self.source}'s event device, such as "
                "/dev/input/by-id/usb-..."
            )
        if len(set(self.keys)) < len(self.keys):
            raise UserError(f"key, retract_key and stop_key are not all different: {self.keys}")
        if self.speed_axis != NONE and self.source == PEDAL:
            raise UserError(f"speed_axis = {self.speed_axis}: a pedal has none")
        if self.axis_at_zero == self.axis_at_full:
            raise UserError(f"axis_at_zero and axis_at_full are both {self.axis_at_full}")

    @property
    def keys(self) -> tuple[int, ...]:
        """The assigned keys: insert, retract, stop."""
        return tuple(key for key in (self.key, self.retract_key, self.stop_key) if key != NONE)

    def speed(self, axis: float) -> float:
        """Return the share of `speed_scale`, 0..1, for a reading of the axis."""
        share = (axis - self.axis_at_zero) / (self.axis_at_full - self.axis_at_zero)
        return min(max(share, 0.0), 1.0)
