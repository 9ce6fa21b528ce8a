"""Writing half of the recorder."""
