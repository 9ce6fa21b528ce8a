"""The bounds of the safety rules, each once."""

from __future__ import annotations

import dataclasses
import math

from needle_common.settings.bounds import ABOVE_0, check_bounds

# No configuration reaches beyond these: they are properties of the rig, not of a run.
HARD_SPEED_CAP = 0.005
HARD_STEP_LENGTH_CAP = 0.005
HARD_HOLD_TIMEOUT_CAP = 0.5
# The longest step there is, at a hundredth of a millimetre a second, and some more [s].
HARD_STEP_TIME_CAP = 600.0


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
        Fastest insertion of a command [m/s], at most 5 mm/s.
    max_rotation_step : float
        Largest rotation of one command [rad].
    max_rotation_rate : float
        Fastest rotation of a command [rad/s].
    max_turns : float
        Largest rotation either way from home, in turns [-].
    hold_timeout : float
        A hold message counts so long after its arrival [s].
    tip_age_limit : float
        A command counts if the tip behind it is not older [s].
    reply_age_limit : float
        An axis that says nothing for longer has failed [s].
    retraction_speed : float
        Insertion axis, outward [m/s].
    homing_speed : float
        Insertion axis, towards its switch, needle out [m/s].
    homing_rotation_rate : float
        Rotation axis, towards its switch, needle out [rad/s].
    insertion_following_error, rotation_following_error : float
        Largest distance of an axis from its set-point [m], [rad].
    insertion_tolerance, rotation_tolerance : float
        A motion has ended when each axis is so close to its target [m], [rad].
    settling_time : float
        How long an axis may take for that after its last set-point [s].
    """

    max_depth: float = 0.2
    max_step_length: float = 0.002
    max_speed: float = HARD_SPEED_CAP
    max_rotation_step: float = 1.2
    max_rotation_rate: float = math.pi
    max_turns: float = 10.0
    hold_timeout: float = 0.25
    tip_age_limit: float = 2.0
    reply_age_limit: float = 0.1
    retraction_speed: float = 0.002
    homing_speed: float = 0.002
    homing_rotation_rate: float = 1.0
    insertion_following_error: float = 0.0005
    rotation_following_error: float = 0.1
    insertion_tolerance: float = 1e-6
    rotation_tolerance: float = 1e-4
    settling_time: float = 1.0

    def __post_init__(self) -> None:
        """Refuse bounds that bound nothing.

        Raises
        ------
        UserError
            A limit that is not finite, not positive, or above its hard cap.
        """
        caps = {
            "max_step_length": HARD_STEP_LENGTH_CAP,
            "max_speed": HARD_SPEED_CAP,
            "retraction_speed": HARD_SPEED_CAP,
            "homing_speed": HARD_SPEED_CAP,
            "hold_timeout": HARD_HOLD_TIMEOUT_CAP,
        }
        for field in dataclasses.fields(self):
            value, upper = getattr(self, field.name), caps.get(field.name, math.inf)
            check_bounds(field.name, value, ABOVE_0, upper, "SI")

    @property
    def max_rotation(self) -> float:
        """Largest rotation either way from home [rad]."""
        return self.max_turns * 2.0 * math.pi

    @property
    def max_homing_time(self) -> float:
        """Homing over the whole travel of both axes, and half as much again [s]."""
        return 1.5 * max(
            self.max_depth / self.homing_speed, self.max_rotation / self.homing_rotation_rate
        )
