"""Cameras that look through the phantom's flat surface."""
