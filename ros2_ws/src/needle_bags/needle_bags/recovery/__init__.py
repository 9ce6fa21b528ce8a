"""Bags made whole: everything before the first damage."""
