"""The next insertion step from where the needle was seen."""

from __future__ import annotations

from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.steering_types import SendStep, SteeringSettings

DEPTH_TOLERANCE = 1e-6
"""Insertion short of the depth that counts as there [m]."""
# A last step may be longer by this share, rather than be followed by one of next to nothing.
_STRETCH = 1e-3


def next_step(
    stamp_ns: int, joints: JointSample, rotation_rate: float, settings: SteeringSettings
) -> SendStep | None:
    """Return the step to send, None where the needle is at the depth.

    Parameters
    ----------
    stamp_ns : int
        Stamp of the tip it is made from [ns].
    joints : JointSample
        The joints at that tip's exposure.
    rotation_rate : float
        What the law wants, u [rad/m].
    settings : SteeringSettings
        Step length, speed and depth.
    """
    remaining = settings.depth - joints.insertion
    if remaining <= DEPTH_TOLERANCE:
        return None
    length = settings.step_length
    is_last = remaining < length * (1.0 + _STRETCH)
    if is_last:
        length = remaining
    return SendStep(
        stamp_ns=stamp_ns,
        # Not joints + length: the last step ends at the depth to the last bit.
        insertion=settings.depth if is_last else joints.insertion + length,
        rotation=joints.rotation + rotation_rate * length,
        duration=length / settings.nominal_speed,
    )
