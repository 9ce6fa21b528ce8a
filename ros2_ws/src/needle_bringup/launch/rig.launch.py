"""The nodes that run beside a rig's own cameras and drives; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup rig.launch.py calibration:=FILE drives:=FILE bag:=DIR

Starts tracker, controller and recorder, and the driver where `drives` names its configuration
(docs/hardware.md). The cameras and the person's hold (`ros2 run needle_bringup operator`) come from
elsewhere: nothing in here moves a needle by itself. A file that is missing ends the launch before a
node starts, and a node that ends ends the others.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import nodes_beside_rig
from needle_core.files.installed import find_shared_file


def generate_launch_description() -> LaunchDescription:
    """Return the graph beside a rig."""
    calibration = str(find_shared_file("needle_tracker", "config/calibration.yaml"))
    arguments = {
        "calibration": (calibration, "the stereo calibration"),
        "drives": ("", "the drives' parameter file; empty: none"),
        "bag": ("", "new bag; empty: none"),
        "params": ("", "parameter file for any node; empty: none"),
    }
    return describe(arguments, nodes_beside_rig)
