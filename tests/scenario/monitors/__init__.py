"""Monitors of a run from outside: invariants, limits, holds and recordings."""
