"""Drawings and texts from snapshots of the rig."""
