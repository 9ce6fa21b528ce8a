"""Tip positions to the rotation of each insertion step (Kallem and Cowan 2009)."""
