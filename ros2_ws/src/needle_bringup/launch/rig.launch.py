"""The nodes that run beside a rig's own cameras and drives; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup rig.launch.py calibration:=FILE drives:=FILE bag:=DIR

Starts tracker, controller and recorder, and the driver where `drives` names its configuration
(docs/hardware.md). The cameras and the person's hold switch come from elsewhere: nothing in here
moves a needle by itself.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument
from launch.conditions import LaunchConfigurationNotEquals
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, SetParametersFromFile

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the graph beside a rig."""
    calibration = str(
        Path(get_package_share_directory("needle_tracker")) / "config" / "calibration.yaml"
    )
    params = LaunchConfiguration("params")
    calibration_file = {"calibration_file": LaunchConfiguration("calibration")}
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "calibration", default_value=calibration, description="the stereo calibration"
            ),
            DeclareLaunchArgument("bag", default_value="", description="new bag; empty: none"),
            DeclareLaunchArgument(
                "params", default_value="", description="parameter file for any node; empty: none"
            ),
            SetParametersFromFile(params, condition=LaunchConfigurationNotEquals("params", "")),
            DeclareLaunchArgument(
                "drives", default_value="", description="the drives' parameter file; empty: none"
            ),
            Node(
                package="needle_device_driver",
                executable="device_driver",
                parameters=[LaunchConfiguration("drives")],
                output="screen",
                condition=LaunchConfigurationNotEquals("drives", ""),
            ),
            Node(
                package="needle_bringup",
                executable="recorder",
                parameters=[calibration_file, {"bag": LaunchConfiguration("bag")}],
                condition=LaunchConfigurationNotEquals("bag", ""),
            ),
            Node(
                package="needle_tracker",
                executable="stereo_tracker",
                parameters=[calibration_file],
                output="screen",
            ),
            Node(
                package="needle_controller",
                executable="plane_controller",
                output="screen",
            ),
        ]
    )
