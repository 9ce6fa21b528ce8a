"""The needle in one image: paths, shaft, end."""
