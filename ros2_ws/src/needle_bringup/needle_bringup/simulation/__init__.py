"""Simulated rig: `simulate`, `console`, and the nodes of the launch files."""
