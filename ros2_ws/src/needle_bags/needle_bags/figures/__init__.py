"""Figures and film of a run, or of two."""
