"""Checks of what the steps of the project must show, at full size."""
