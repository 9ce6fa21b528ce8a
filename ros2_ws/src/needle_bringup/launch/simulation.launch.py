"""The simulated rig: sim_rig, tracker and controller; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup simulation.launch.py level:=tip operator:=true bag:=bags/by_launch

`scripts/simulate` does the same without `launch`, and reports.
"""

from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition, LaunchConfigurationEquals, LaunchConfigurationNotEquals
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node, SetParametersFromFile
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a simulated run."""
    params = LaunchConfiguration("params")
    sim_time = {"use_sim_time": True}
    with_drives = LaunchConfigurationEquals("level", "drive")
    operator = Node(
        package="needle_bringup",
        executable="operator",
        parameters=[sim_time],
        output="screen",
        condition=IfCondition(LaunchConfiguration("operator")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "level", default_value="camera", description="tip, camera or drive"
            ),
            DeclareLaunchArgument("seed", default_value="1", description="seed of all noise"),
            DeclareLaunchArgument(
                "real_time_factor", default_value="1.0", description="0.0: lock step"
            ),
            DeclareLaunchArgument(
                "controller", default_value="best", description="best, paper or open_loop"
            ),
            DeclareLaunchArgument(
                "operator", default_value="false", description="let the stand-in keep the hold"
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
            SetParametersFromFile(params, condition=LaunchConfigurationNotEquals("params", "")),
            Node(
                package="needle_bringup",
                executable="recorder",
                parameters=[{"bag": LaunchConfiguration("bag")}],
                condition=LaunchConfigurationNotEquals("bag", ""),
            ),
            Node(
                package="needle_sim",
                executable="sim_rig",
                parameters=[
                    sim_time,
                    {
                        "level": LaunchConfiguration("level"),
                        "seed": ParameterValue(LaunchConfiguration("seed"), value_type=int),
                        "real_time_factor": ParameterValue(
                            LaunchConfiguration("real_time_factor"), value_type=float
                        ),
                    },
                ],
                output="screen",
            ),
            Node(
                package="needle_tracker",
                executable="stereo_tracker",
                parameters=[sim_time],
                output="screen",
                condition=LaunchConfigurationNotEquals("level", "tip"),
            ),
            Node(
                package="needle_sim",
                executable="drive_emulator",
                parameters=[
                    sim_time,
                    {"pty": LaunchConfiguration("can"), "motion_clock": "sync"},
                ],
                output="screen",
                condition=with_drives,
            ),
            Node(
                package="needle_device_driver",
                executable="device_driver",
                parameters=[
                    sim_time,
                    {
                        "link": "slcan",
                        "channel": LaunchConfiguration("can"),
                        "lock_step": ParameterValue(
                            PythonExpression([LaunchConfiguration("real_time_factor"), " == 0.0"]),
                            value_type=bool,
                        ),
                    },
                ],
                output="screen",
                condition=with_drives,
            ),
            Node(
                package="needle_controller",
                executable="plane_controller",
                parameters=[sim_time, {"preset": LaunchConfiguration("controller")}],
                output="screen",
            ),
            operator,
            # The run is over with the operator; without one, with Ctrl-C.
            RegisterEventHandler(
                OnProcessExit(target_action=operator, on_exit=[EmitEvent(event=Shutdown())])
            ),
        ]
    )
