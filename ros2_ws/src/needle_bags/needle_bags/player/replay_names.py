"""Under which names a bag is played: nothing of it may ever move a needle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

REPLAY: Final = "/replay"
# What a rig obeys, whatever its namespace: commands, holds, emergency stops and targets. Recorded
# parameter events would change the clock of nodes that carry the recorded names.
_GUARDED_NAMES: Final = (
    "/device/joint_trajectory",
    "/device/hold",
    "/device/estop",
    "/target_plane",
    "/target_point",
    "/obstacles",
    "/parameter_events",
)
# The same, under whatever name it was recorded.
_GUARDED_TYPES: Final = (
    "trajectory_msgs/msg/JointTrajectory",
    "sensor_msgs/msg/Joy",
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
)
# A driver publishes this; where one is, a rig is.
_RIG_MARK: Final = "/device/status"


def is_guarded(name: str, type_name: str) -> bool:
    """Return whether a topic is one that a rig obeys.

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


def played_name(
    name: str, type_name: str, remaps: Mapping[str, str], *, beside_rig: bool = False
) -> str:
    """Return the name under which a recorded topic is played.

    Parameters
    ----------
    name, type_name : str
        As recorded.
    remaps : mapping
        Absolute recorded name to absolute wanted name.
    beside_rig : bool
        Whether a rig is alive on the graph: then everything is played under `replay/`.
    """
    wanted = remaps.get(name, name)
    if wanted.startswith(f"{REPLAY}/"):
        return wanted
    if beside_rig or is_guarded(name, type_name) or is_guarded(wanted, type_name):
        return REPLAY + wanted
    return wanted


def marks_a_rig(name: str) -> bool:
    """Return whether a topic's publisher is a rig's driver."""
    return name.endswith(_RIG_MARK) and not name.startswith(f"{REPLAY}/")
