"""The package's executables."""

from needle_common.commands.executables import node

operator = node("needle_bringup.ros.operator")
