"""Whole runs of the rig in one process, under faults, with all that must hold watched."""
