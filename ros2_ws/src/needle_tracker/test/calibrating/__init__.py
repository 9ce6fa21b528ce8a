"""Calibration: its tests, and the rig of their own that they calibrate."""
