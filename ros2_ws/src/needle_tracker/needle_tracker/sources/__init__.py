"""Sources of images and joint states, and their matching by stamp."""
