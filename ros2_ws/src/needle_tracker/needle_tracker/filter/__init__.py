"""Candidate tips over time in, the believed tip out."""
