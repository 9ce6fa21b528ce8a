"""Whole runs of the rig in one process under faults, with all invariants checked."""
