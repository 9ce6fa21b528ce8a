"""Order of what the operator stand-in does."""
