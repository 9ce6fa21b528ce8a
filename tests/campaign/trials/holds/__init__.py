"""Trials of the hold: a loss ends the motion, and nothing resumes by itself."""
