"""Recorded runs, straight from their bags."""
