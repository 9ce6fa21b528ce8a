"""Calibration of the rig from images of a board, and check of an existing calibration."""
