"""Parameters of nodes as plain data."""
