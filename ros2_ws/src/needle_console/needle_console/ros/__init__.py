"""Node of the console."""
