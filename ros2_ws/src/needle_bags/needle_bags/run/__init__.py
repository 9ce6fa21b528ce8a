"""Summary, events and timing of a run."""
