"""A bag played for RViz, Foxglove and the like; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup replay.launch.py bag:=DIR rate:=0.5 loop:=true

Plays the bag and runs the live view beside it (docs/viewers.md). Commands, holds and targets are
played under /replay only: no rig moves by it. The launch ends with the bag.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import replay_words, replayed_nodes


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a bag that is played."""
    arguments = {
        "bag": ("", "the bag's folder"),
        "rate": ("1.0", "times as fast"),
        "start": ("0.0", "begin here [s]"),
        "loop": ("false", "begin again at the end"),
    }
    return describe(arguments, replayed_nodes, {"loop": ("true", "false")}, replay_words)
