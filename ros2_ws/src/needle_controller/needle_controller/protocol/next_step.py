"""The next insertion step from where the needle was seen."""

from __future__ import annotations

from needle_controller.laws.law import SteeringCommand
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import SendStep

DEPTH_TOLERANCE = 1e-6
"""Insertion short of the depth that counts as there [m]."""
POINT_TOLERANCE = 1e-4
"""Insertion left to a point that counts as there: what a tip is known to [m]."""
# A last step may be longer by this share, rather than be followed by one of next to nothing.
_STRETCH = 1e-3
_SLOWER = 2.0


def next_step(
    stamp_ns: int,
    joints: JointSample,
    command: SteeringCommand,
    settings: SteeringSettings,
    *,
    slowly: bool,
) -> SendStep | None:
    """Return the step to send, None where the needle is at the depth, or at its point.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the tip it is made from [ns].
    joints : JointSample
        The joints at that tip's exposure.
    command : SteeringCommand
        What the law wants.
    settings : SteeringSettings
        Step length, speed and depth.
    slowly : bool
        Whether to go at half the speed: where the estimate is in doubt.
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
        stamp_ns=stamp_ns,
        # Not joints + length: the last step ends at the depth to the last bit.
        insertion=end if is_last else joints.insertion + length,
        rotation=joints.rotation + float(command.rotation_rate) * length,
        duration=length / settings.nominal_speed * (_SLOWER if slowly else 1.0),
    )
