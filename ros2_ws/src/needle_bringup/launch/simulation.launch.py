"""Simulated rig: sim_rig, tracker and controller; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup simulation.launch.py level:=tip simulated_operator:=true

`scripts/simulate` does the same without `launch`, and writes a report. Without
`simulated_operator:=true` another node must publish device/hold. The launch ends when a node exits.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import simulated_nodes
from needle_bringup.simulation.simulate_options import CONTROLLERS, LEVELS


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a simulated run."""
    arguments = {
        "level": ("camera", "what is simulated: tips, images, or images and drives"),
        "seed": ("1", "seed of all random numbers"),
        "controller": ("best", "preset that rotates the needle"),
        "simulated_operator": ("false", "press the hold automatically"),
        "bag": ("", "new bag; empty: no recording"),
        "can": ("/tmp/needle_can", "level drive: path of the emulated CAN adapter"),
        "params": ("", "parameter file for any node; empty: none"),
    }
    choices = {"level": LEVELS, "controller": CONTROLLERS, "simulated_operator": ("true", "false")}
    return describe(arguments, simulated_nodes, choices)
