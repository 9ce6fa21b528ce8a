"""Axes whose drives speak CiA 402."""
