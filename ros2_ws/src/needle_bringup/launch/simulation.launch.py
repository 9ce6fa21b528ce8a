"""The simulated rig: sim_rig, tracker and controller; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup simulation.launch.py level:=tip operator:=true bag:=bags/by_launch

`scripts/simulate` does the same without `launch`, and reports. Without `operator:=true` time starts
when somebody else sends device/hold. The launch ends with the operator, and with any other node.
"""

from launch.actions import DeclareLaunchArgument

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import simulated_nodes
from needle_bringup.simulation.simulate_options import CONTROLLERS, LEVELS


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a simulated run."""
    return describe(
        [
            DeclareLaunchArgument(
                "level", default_value="camera", choices=LEVELS, description="what is simulated"
            ),
            DeclareLaunchArgument("seed", default_value="1", description="seed of all noise"),
            DeclareLaunchArgument(
                "real_time_factor", default_value="1.0", description="0.0: lock step"
            ),
            DeclareLaunchArgument(
                "controller",
                default_value="best",
                choices=CONTROLLERS,
                description="how the needle is turned",
            ),
            DeclareLaunchArgument(
                "operator",
                default_value="false",
                choices=("true", "false"),
                description="let the stand-in keep the hold",
            ),
            DeclareLaunchArgument("bag", default_value="", description="new bag; empty: none"),
            DeclareLaunchArgument(
                "can",
                default_value="/tmp/needle_can",
                description="level drive: where the emulated CAN adapter appears",
            ),
            DeclareLaunchArgument(
                "params", default_value="", description="parameter file for any node; empty: none"
            ),
        ],
        simulated_nodes,
    )
