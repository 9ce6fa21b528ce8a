"""The CAN bus behind whatever adapter there is, and the objects read and written over it."""
