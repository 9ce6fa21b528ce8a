"""Kinds of drives, one module each."""
