"""The package's executables."""

from needle_core.commands.executables import node

device_driver = node("needle_device_driver.ros.device_driver")
