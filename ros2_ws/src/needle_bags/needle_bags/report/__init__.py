"""HTML pages of a run, or of two."""
