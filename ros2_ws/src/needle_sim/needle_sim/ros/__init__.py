"""The simulated rig behind the rig's topics and services."""
