"""Parameters as plain data."""
