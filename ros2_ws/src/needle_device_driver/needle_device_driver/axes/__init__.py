"""Axes and their coordinated motion."""
