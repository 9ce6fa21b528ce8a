"""Axes on CiA 402 drives."""
