"""Image sequences on the command line, by either renderer."""
