"""The package's executables."""

from needle_common.commands.executables import node

simulated_operator = node("needle_bringup.ros.simulated_operator")
