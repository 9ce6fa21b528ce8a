"""Access control of connections: Host and Origin."""
