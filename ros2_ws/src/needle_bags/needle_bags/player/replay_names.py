"""Topic names of a played bag, chosen so that its messages can never move a needle."""

from __future__ import annotations

from typing import Final

REPLAY: Final = "/replay"
# Topics that control a rig in any namespace: commands, holds, emergency stops and targets. Recorded
# parameter events would change the clock of nodes with the recorded names.
_GUARDED_NAMES: Final = (
    "/device/joint_trajectory",
    "/device/hold",
    "/device/estop",
    "/target_plane",
    "/target_point",
    "/obstacles",
    "/parameter_events",
)
# Types of such messages, guarded under any name.
_GUARDED_TYPES: Final = (
    "trajectory_msgs/msg/JointTrajectory",
    "sensor_msgs/msg/Joy",
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
)
# Published by the driver of a rig.
_RIG_MARK: Final = "/device/status"


def is_guarded(name: str, type_name: str) -> bool:
    """Return whether a topic controls a rig.

    Parameters
    ----------
    name : str
        Absolute name.
    type_name : str
        `package/msg/Name`.
    """
    if name.startswith(f"{REPLAY}/"):
        return False
    return type_name in _GUARDED_TYPES or name.endswith(_GUARDED_NAMES)


def played_name(name: str, type_name: str, *, alongside_rig: bool = False) -> str:
    """Return the name of a recorded topic during playback.

    Parameters
    ----------
    name, type_name : str
        Recorded name and type.
    alongside_rig : bool
        Whether a rig is on the graph; if so, everything is played under `replay/`.
    """
    if name.startswith(f"{REPLAY}/"):
        return name
    return REPLAY + name if alongside_rig or is_guarded(name, type_name) else name


def marks_a_rig(name: str) -> bool:
    """Return whether a topic is published by the driver of a rig."""
    return name.endswith(_RIG_MARK) and not name.startswith(f"{REPLAY}/")
