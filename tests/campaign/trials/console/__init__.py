"""Trials of the console in a real browser."""
