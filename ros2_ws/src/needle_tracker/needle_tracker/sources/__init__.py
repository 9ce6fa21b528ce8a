"""Where images and joint states come from, and which belong together."""
