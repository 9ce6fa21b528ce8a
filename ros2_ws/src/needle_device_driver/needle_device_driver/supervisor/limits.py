"""Bounds of the safety rules, as limits and as parameters of a node."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from needle_core.settings.parameter_fields import check_fields, fixed_parameter

# Caps for every configuration: properties of the rig.
HARD_SPEED_CAP = 0.005
HARD_STEP_LENGTH_CAP = 0.005
HARD_HOLD_TIMEOUT_CAP = 0.5
# Longest step: 5 mm at 0.01 mm/s, plus a margin [s].
HARD_STEP_TIME_CAP = 600.0
_SMALLEST = 1e-5
_FOLLOWING = "Maximum distance from the set-point."
_TOLERANCE = "Position tolerance at the target."


@dataclasses.dataclass(frozen=True)
class SafetyLimits:
    """The bounds of the safety rules.

    Attributes
    ----------
    max_depth : float
        Deepest insertion [m].
    max_step_length : float
        Longest insertion of one command [m].
    max_speed : float
        Highest insertion speed of a command [m/s], at most 5 mm/s.
    max_rotation_step : float
        Largest rotation of one command [rad].
    max_rotation_rate : float
        Highest rotation rate of a command [rad/s].
    max_turns : float
        Largest rotation from home in either direction, in turns [-].
    hold_timeout : float
        Lifetime of a hold message after its arrival [s].
    tip_age_limit : float
        Greatest age of the tip behind a command [s].
    reply_age_limit : float
        Time of silence after which an axis has failed [s].
    retraction_speed : float
        Speed of a retraction [m/s].
    homing_speed : float
        Speed of the insertion axis towards its switch [m/s].
    homing_rotation_rate : float
        Speed of the rotation axis towards its switch [rad/s].
    insertion_following_error, rotation_following_error : float
        Largest distance of an axis from its set-point [m], [rad].
    insertion_tolerance, rotation_tolerance : float
        Largest distance from the target at the end of a motion [m], [rad].
    settling_time : float
        Longest time to reach the target after the last set-point [s].
    """

    max_depth: float = fixed_parameter(0.2, "m", "Maximum insertion depth.", 0.001, 0.5)
    max_step_length: float = fixed_parameter(
        0.002, "m", "Maximum insertion per command.", _SMALLEST, HARD_STEP_LENGTH_CAP
    )
    max_speed: float = fixed_parameter(
        HARD_SPEED_CAP, "m/s", "Maximum insertion speed of a command.", _SMALLEST, HARD_SPEED_CAP
    )
    max_rotation_step: float = fixed_parameter(
        1.2, "rad", "Maximum rotation per command.", 0.01, 2 * math.pi
    )
    max_rotation_rate: float = fixed_parameter(
        math.pi, "rad/s", "Maximum rotation rate of a command.", 0.01, 20.0
    )
    max_turns: float = fixed_parameter(
        10.0, "turns", "Maximum rotation from home, in either direction.", 0.1, 1000.0
    )
    hold_timeout: float = fixed_parameter(
        0.25,
        "s",
        "Time after its arrival for which a hold message is valid (monotonic clock).",
        0.05,
        HARD_HOLD_TIMEOUT_CAP,
    )
    tip_age_limit: float = fixed_parameter(
        2.0, "s", "Maximum age of the tip that a command is based on (monotonic clock).", 0.05, 60.0
    )
    reply_age_limit: float = fixed_parameter(
        0.1, "s", "A drive that sends nothing for this long has failed.", 0.05, 0.5
    )
    retraction_speed: float = fixed_parameter(
        0.002, "m/s", "Retraction speed.", _SMALLEST, HARD_SPEED_CAP
    )
    homing_speed: float = fixed_parameter(
        0.002, "m/s", "Homing speed of the insertion axis.", _SMALLEST, HARD_SPEED_CAP
    )
    homing_rotation_rate: float = fixed_parameter(
        1.0, "rad/s", "Homing speed of the rotation axis.", 0.01, 20.0
    )
    insertion_following_error: float = fixed_parameter(0.0005, "m", _FOLLOWING, 1e-6, 10.0)
    rotation_following_error: float = fixed_parameter(0.1, "rad", _FOLLOWING, 1e-6, 10.0)
    insertion_tolerance: float = fixed_parameter(1e-6, "m", _TOLERANCE, 1e-7, 1.0)
    rotation_tolerance: float = fixed_parameter(1e-4, "rad", _TOLERANCE, 1e-7, 1.0)
    settling_time: float = fixed_parameter(
        1.0, "s", "Maximum time to reach the target after the last set-point.", 0.1, 10.0
    )

    def __post_init__(self) -> None:
        """Check the limits.

        Raises
        ------
        UserError
            If a limit is not finite, or outside the bounds of its parameter.
        """
        check_fields(self)

    @classmethod
    def of(cls, parameters: Any) -> SafetyLimits:
        """Return the limits among the fields of a parameter dataclass; the others are the defaults.

        Parameters
        ----------
        parameters : dataclass instance
            Fields with the name of a limit are limits.
        """
        own = {field.name for field in dataclasses.fields(parameters)}
        names = [field.name for field in dataclasses.fields(cls) if field.name in own]
        return cls(**{name: getattr(parameters, name) for name in names})

    @property
    def max_rotation(self) -> float:
        """Largest rotation from home in either direction [rad]."""
        return self.max_turns * 2.0 * math.pi

    @property
    def longest_homings(self) -> tuple[float, float]:
        """Longest homing of each axis: 1.5 times the time for its whole travel [s]."""
        return (
            1.5 * self.max_depth / self.homing_speed,
            1.5 * self.max_rotation / self.homing_rotation_rate,
        )


def limit_parameter(name: str) -> Any:
    """Return the field `name` of `SafetyLimits` for a parameter dataclass."""
    (field,) = (field for field in dataclasses.fields(SafetyLimits) if field.name == name)
    return dataclasses.field(default=field.default, metadata=field.metadata)
