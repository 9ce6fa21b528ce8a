"""Order of what a person's stand-in does in simulation."""
