"""Drives that answer requests: common code of the Galil, Zaber and step/direction backends."""
