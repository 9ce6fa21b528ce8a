"""Monitors of a run from outside: invariants, limits and holds."""
