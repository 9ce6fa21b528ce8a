"""Runners of components."""
