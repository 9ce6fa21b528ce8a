"""Needle ends of both views in, candidate tips in space out."""
