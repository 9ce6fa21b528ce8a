"""States and actions of the step protocol, and the computation of the next insertion step."""

from __future__ import annotations

import dataclasses
import enum

from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import ControlUpdate
from needle_core.component import Log

DEPTH_TOLERANCE = 1e-6
"""Remaining insertion at which the depth counts as reached [m]."""
POINT_TOLERANCE = 1e-4
"""Remaining insertion at which a target point counts as reached [m]: the accuracy of a tip."""
_STRETCH = 1e-3
"""Share by which the last step may be longer, to avoid a further step of almost no length."""
_CAUTIOUS_SLOWDOWN = 2.0


class SteeringState(enum.Enum):
    """States of the controller."""

    IDLE = "IDLE"
    STEERING = "STEERING"
    WAITING_FOR_TIP = "WAITING_FOR_TIP"
    DONE = "DONE"
    FAULT = "FAULT"


class Awaiting(enum.Enum):
    """Input that the next action needs."""

    NOTHING = "nothing"
    HOLD = "hold"
    TIP = "tip"
    DEVICE = "device"
    RESULT = "result"


@dataclasses.dataclass(frozen=True)
class SendStep:
    """Send one trajectory point.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that the step was computed from [ns].
    insertion, rotation : float
        Absolute joint positions at the end of the step [m], [rad].
    duration : float
        Time from start [s].
    """

    stamp_ns: int
    insertion: float
    rotation: float
    duration: float

    @property
    def points(self) -> tuple[tuple[float, float, float], ...]:
        """The step as `SendPath.points`."""
        return ((self.insertion, self.rotation, self.duration),)


@dataclasses.dataclass(frozen=True)
class SendPath:
    """Send the path ahead, which replaces the present one.

    Attributes
    ----------
    stamp_ns : int
        Stamp of the tip that the path was computed from or confirmed by [ns].
    points : tuple of tuple of float
        Insertion [m], rotation [rad] and time from start [s] of each point; the path begins at
        the first, at time 0.
    """

    stamp_ns: int
    points: tuple[tuple[float, float, float], ...]


@dataclasses.dataclass(frozen=True)
class PublishUpdate:
    """Publish estimate and control input, stamped with the tip's exposure."""

    stamp_ns: int
    update: ControlUpdate


Action = SendStep | SendPath | PublishUpdate | Log


@dataclasses.dataclass(frozen=True)
class StartReply:
    """Answer to a service call."""

    success: bool
    message: str


def next_step(
    joints: JointSample, command: SteeringCommand, settings: SteeringSettings, *, slowly: bool
) -> SendStep | None:
    """Return the next step; None if the needle has reached the depth or its target point.

    Parameters
    ----------
    joints : JointSample
        Joint positions at the exposure of the tip that the step is computed from.
    command : SteeringCommand
        Output of the control law.
    settings : SteeringSettings
        Step length, speed and depth.
    slowly : bool
        Whether to move at half the speed because the estimate is uncertain.
    """
    end = settings.depth
    if command.insertion_left is not None:
        left = float(command.insertion_left)
        if left <= POINT_TOLERANCE:
            return None
        end = min(end, joints.insertion + left)
    remaining = end - joints.insertion
    if remaining <= DEPTH_TOLERANCE:
        return None
    length = settings.step_length
    is_last = remaining < length * (1.0 + _STRETCH)
    if is_last:
        length = remaining
    return SendStep(
        stamp_ns=joints.stamp_ns,
        # The last step ends exactly at the depth: joints + length may differ in the last bit.
        insertion=end if is_last else joints.insertion + length,
        rotation=joints.rotation + float(command.rotation_rate) * length,
        duration=length / settings.nominal_speed * (_CAUTIOUS_SLOWDOWN if slowly else 1.0),
    )
