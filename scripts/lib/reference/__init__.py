"""Reference pages of the documentation site, generated from the nodes and commands."""
