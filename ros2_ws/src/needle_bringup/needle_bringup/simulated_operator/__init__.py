"""Simulated operator: presses the hold of a simulated rig."""
