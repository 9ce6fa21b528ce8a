"""Estimators of the needle's state, and their common interface."""
