"""Steering of a bevel-tip needle into a plane: measured tips in, rotation of each step out."""
