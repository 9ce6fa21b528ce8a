"""Who may open a connection: token, Origin and Host."""
