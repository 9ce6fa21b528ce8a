"""Recorded inputs processed by the current code."""
