"""Bags of the rig: recorder, player, recovery, rerun, report, and the live view."""
