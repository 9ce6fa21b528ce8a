"""The safety limits as parameters: the same for every node that wraps a supervisor around axes."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from needle_common.settings.parameter_fields import fixed_parameter
from needle_device_driver.supervisor.limits import (
    HARD_HOLD_TIMEOUT_CAP,
    HARD_SPEED_CAP,
    HARD_STEP_LENGTH_CAP,
    SafetyLimits,
)

_SMALLEST = 1e-5
_FIELDS = {
    "max_depth": ("m", "Deepest insertion.", 0.001, 0.5),
    "max_step_length": (
        "m",
        "Longest insertion of one command.",
        _SMALLEST,
        HARD_STEP_LENGTH_CAP,
    ),
    "max_speed": ("m/s", "Fastest insertion of a command.", _SMALLEST, HARD_SPEED_CAP),
    "max_rotation_step": ("rad", "Largest rotation of one command.", 0.01, 2 * math.pi),
    "max_rotation_rate": ("rad/s", "Fastest rotation of a command.", 0.01, 20.0),
    "max_turns": ("turns", "Largest rotation either way from home.", 0.1, 1000.0),
    "hold_timeout": (
        "s",
        "A hold message counts so long after its arrival, steady clock.",
        0.05,
        HARD_HOLD_TIMEOUT_CAP,
    ),
    "tip_age_limit": (
        "s",
        "A command is refused if the tip behind it is older, steady clock.",
        0.05,
        60.0,
    ),
    "retraction_speed": (
        "m/s",
        "Speed at which the needle is drawn out.",
        _SMALLEST,
        HARD_SPEED_CAP,
    ),
    "homing_speed": ("m/s", "Towards the insertion switch.", _SMALLEST, HARD_SPEED_CAP),
    "homing_rotation_rate": ("rad/s", "Towards the rotation switch.", 0.01, 20.0),
    "settling_time": ("s", "To reach the target after the last set-point.", 0.1, 10.0),
}


def limit_parameter(name: str) -> Any:
    """Declare the field `name` of `SafetyLimits` as a field of a parameter dataclass."""
    return fixed_parameter(getattr(SafetyLimits, name), *_FIELDS[name])


def limits_of(parameters: Any) -> SafetyLimits:
    """Return the limits that a parameter dataclass has; the others are the defaults.

    Raises
    ------
    OutOfBoundsError
        As of `SafetyLimits`.
    """
    names = {field.name for field in dataclasses.fields(SafetyLimits)}
    own = [field.name for field in dataclasses.fields(parameters) if field.name in names]
    return SafetyLimits(**{name: getattr(parameters, name) for name in own})
