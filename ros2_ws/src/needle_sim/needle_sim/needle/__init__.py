"""Needle on SE(3) in tissue."""
