"""Trials of running nodes: bad input, faults, kills, floods."""
