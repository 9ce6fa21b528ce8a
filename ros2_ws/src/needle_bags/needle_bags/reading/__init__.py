"""Access to recorded runs."""
