"""Basis of all nodes and commands of the rig: components, messages, runners, settings, errors."""
