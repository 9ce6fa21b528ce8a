"""Sources of images and joint states, and which belong together."""
