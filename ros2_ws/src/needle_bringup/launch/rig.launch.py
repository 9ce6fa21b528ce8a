"""Nodes of a real rig, without its cameras; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup rig.launch.py calibration:=FILE drives:=FILE bag:=DIR
    ros2 launch needle_bringup rig.launch.py registration:=FILE drives:=FILE bag:=DIR

Starts the controller, stereo_tracker or, if `registration` is given, tracked_tip, the recorder if
`bag` is given, and the driver if `drives` is given (docs/hardware.md). Start the cameras and the
hold-to-run switch (`ros2 run needle_bringup operator`) separately: no node of this launch moves a
needle without the hold. A missing file ends the launch before a node starts; if a node exits, the
others end.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import nodes_alongside_rig
from needle_core.files.installed import find_shared_file


def generate_launch_description() -> LaunchDescription:
    """Return the graph of the nodes that run alongside a rig."""
    calibration = str(find_shared_file("needle_tracker", "config/calibration.yaml"))
    arguments = {
        "calibration": (calibration, "calibration file of the stereo rig"),
        "registration": ("", "file of register_tracker, for a tracker instead of cameras"),
        "drives": ("", "parameter file of the drives; empty: no driver"),
        "bag": ("", "new bag; empty: no recording"),
        "params": ("", "parameter file for any node; empty: none"),
    }
    return describe(arguments, nodes_alongside_rig)
