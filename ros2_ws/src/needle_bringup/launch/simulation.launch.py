"""The simulated rig: sim_rig, tracker and controller; for ROS 2 Jazzy with `ros2 launch`.

    ros2 launch needle_bringup simulation.launch.py level:=tip simulated_operator:=true

`scripts/simulate` does the same without `launch`, and reports. Without
`simulated_operator:=true` the needle moves when somebody else sends device/hold. The launch ends
with the operator, and with any other node.
"""

from launch import LaunchDescription
from needle_bringup.ros.launching import describe
from needle_bringup.simulation.launch_nodes import simulated_nodes
from needle_bringup.simulation.simulate_options import CONTROLLERS, LEVELS


def generate_launch_description() -> LaunchDescription:
    """Return the graph of a simulated run."""
    arguments = {
        "level": ("camera", "what is simulated"),
        "seed": ("1", "seed of all noise"),
        "controller": ("best", "how the needle is turned"),
        "simulated_operator": ("false", "let the stand-in keep the hold"),
        "bag": ("", "new bag; empty: none"),
        "can": ("/tmp/needle_can", "level drive: where the emulated CAN adapter appears"),
        "params": ("", "parameter file for any node; empty: none"),
    }
    choices = {"level": LEVELS, "controller": CONTROLLERS, "simulated_operator": ("true", "false")}
    return describe(arguments, simulated_nodes, choices)
