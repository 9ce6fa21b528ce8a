"""Which command would bring what a node waits for: no ROS."""

from __future__ import annotations

from collections.abc import Iterable

_DEVICE = "ros2 run needle_device_driver device_driver; simulated: ros2 run needle_sim sim_rig"
_CONTROLLER = "ros2 run needle_controller plane_controller"
_TRACKER = "ros2 run needle_tracker stereo_tracker"
_CAMERAS = "ros2 run needle_tracker stereo_camera; simulated: ros2 run needle_sim sim_rig"
_RECORDER = "ros2 run needle_bags recorder"
_HOLD = "ros2 run needle_bringup operator; simulated: ros2 run needle_bringup simulated_operator"
_SIM_RIG = "ros2 run needle_sim sim_rig"
_START = (
    "simulated_operator does, or ros2 service call /plane_controller/start std_srvs/srv/Trigger"
)
_DRIVER = "ros2 run needle_device_driver device_driver"
_EMULATOR = "ros2 run needle_sim drive_emulator"

# Beginning of what is missing -> end of its name -> the command; the first that fits counts.
_COMMANDS: tuple[tuple[str, str, str], ...] = (
    ("recorder of ", "", _RECORDER),
    ("publisher of ", "device/joint_trajectory", _CONTROLLER),
    ("publisher of ", "needle/controller_status", _CONTROLLER),
    ("publisher of ", "device/hold", _HOLD),
    ("publisher of ", "needle/tip", _TRACKER),
    ("publisher of ", "needle/tip_pose", _TRACKER),
    ("publisher of ", "/clock", _SIM_RIG),
    ("publisher of ", "sim/drive_positions", _EMULATOR),
    ("publisher of ", "/image_raw", _CAMERAS),
    ("publisher of ", "device/status", _DEVICE),
    ("publisher of ", "device/result", _DEVICE),
    ("publisher of ", "joint_states", _DEVICE),
    ("subscriber of ", "device/joint_trajectory", _DEVICE),
    ("subscriber of ", "device/hold", _DEVICE),
    ("subscriber of ", "/image_raw", _TRACKER),
    ("subscriber of ", "needle/tip", _CONTROLLER),
    ("subscriber of ", "joint_states", _CONTROLLER),
    ("subscriber of ", "device/result", _CONTROLLER),
    ("subscriber of ", "device/status", _CONTROLLER),
    ("service call ", "plane_controller/start", _START),
    ("a driver on the bus", "", _DRIVER),
    ("service ", "plane_controller/start", _CONTROLLER),
    ("service ", "", _DEVICE),
)


def with_commands(missing: Iterable[str]) -> str:
    """Return what is missing as a person reads it, each with the command that brings it.

    Parameters
    ----------
    missing : iterable of str
        As `discovery` names it: `publisher of T`, `subscriber of T`, `recorder of T`,
        `service S`, or anything else.
    """
    by_command: dict[str, list[str]] = {}
    for name in missing:
        by_command.setdefault(_command(name), []).append(name)
    return "; ".join(
        ", ".join(names) + (f" ({command})" if command else "")
        for command, names in by_command.items()
    )


def _command(name: str) -> str:
    for beginning, end, command in _COMMANDS:
        if name.startswith(beginning) and name.endswith(end):
            return command
    return ""
