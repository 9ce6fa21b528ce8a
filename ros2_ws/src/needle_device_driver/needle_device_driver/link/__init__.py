"""CAN bus and its adapters, and access to the objects of the drives."""
