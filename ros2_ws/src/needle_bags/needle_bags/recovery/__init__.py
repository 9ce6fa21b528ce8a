"""Bags made whole of what can be read in them."""
