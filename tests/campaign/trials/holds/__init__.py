"""Trials of what a person holds: a loss ends the motion, and nothing begins again by itself."""
