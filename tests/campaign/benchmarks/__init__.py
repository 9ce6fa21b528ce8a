"""`scripts/bench`: speed and memory, relative to references of the same run."""
