"""Path-traced renderer: stereo images of a metal needle in a clear phantom, with ground truth."""
