"""Node of device_driver."""
