"""Studies of steering: past obstacles, and on the workers of a cluster."""
