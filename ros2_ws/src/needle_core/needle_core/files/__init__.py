"""Access to external files, with bounds, checks and atomic replacement."""
