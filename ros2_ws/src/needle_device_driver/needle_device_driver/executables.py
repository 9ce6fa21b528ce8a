"""The package's executables."""

from needle_common.commands.executables import node

device_driver = node("needle_device_driver.ros.device_driver")
