"""Figures of a run, or of two, and the frames of its film."""
