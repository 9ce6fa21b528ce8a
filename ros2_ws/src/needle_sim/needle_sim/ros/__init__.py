"""Executables of the simulated rig."""
