"""The package's executables."""

from needle_core.commands.executables import command, node

check_drive = command("needle_device_driver.check_drive")
device_driver = node("needle_device_driver.ros.device_driver")
