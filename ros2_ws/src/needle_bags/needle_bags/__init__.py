"""Bags of the rig: recorder, player, recovery, and reading."""
