"""The package's executables."""

from needle_core.commands.executables import command, node

identify_curvature = command("needle_controller.curvature.identify_curvature")
plane_controller = node("needle_controller.ros.plane_controller")
