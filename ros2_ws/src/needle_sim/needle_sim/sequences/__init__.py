"""Image sequences on the command line, with either renderer."""
