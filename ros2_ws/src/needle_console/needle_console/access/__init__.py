"""Access control of connections: token, Origin and Host."""
