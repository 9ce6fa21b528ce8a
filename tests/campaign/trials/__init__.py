"""Trials whose processes are started and killed from outside."""
