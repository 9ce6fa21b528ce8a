"""Tests of the calibration, and the synthetic rigs that they calibrate."""
