"""The package's executables."""

from needle_common.executables import command, node

identify_curvature = command("needle_controller.identify_curvature")
plane_controller = node("needle_controller.plane_controller_node")
