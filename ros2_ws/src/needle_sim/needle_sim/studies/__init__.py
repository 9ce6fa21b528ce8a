"""Thousands of simulated needles at a time."""
