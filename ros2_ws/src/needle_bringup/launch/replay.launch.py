"""Playback of a bag for RViz, Foxglove and other viewers; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup replay.launch.py bag:=DIR rate:=0.5 loop:=true

Plays the bag and runs the live view (docs/viewers.md). Commands, holds and targets are published
under /replay only, so no rig moves. The launch ends with the bag.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import replay_arguments, replayed_nodes


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a bag that is played."""
    arguments = {
        "bag": ("", "directory of the bag"),
        "rate": ("1.0", "playback speed relative to the recording"),
        "start": ("0.0", "start this long after the first message [s]"),
        "loop": ("false", "repeat at the end"),
    }
    return describe(arguments, replayed_nodes, {"loop": ("true", "false")}, replay_arguments)
