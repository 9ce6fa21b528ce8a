"""Drives that answer requests: what Galil, Zaber and step/direction backends have in common."""
