"""Trials whose processes are started, killed and damaged from outside."""
