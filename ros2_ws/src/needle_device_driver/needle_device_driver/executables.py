"""The package's executables."""

from needle_common.executables import node

device_driver = node("needle_device_driver.device_driver_node")
