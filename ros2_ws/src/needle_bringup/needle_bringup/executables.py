"""The package's executables."""

from needle_core.commands.executables import command, node

commission = command("needle_bringup.commission")
operator = node("needle_bringup.ros.operator")
robot_model = command("needle_bringup.simulation.robot_model")
simulated_operator = node("needle_bringup.ros.simulated_operator")
