"""Stereo images of a needle in a clear phantom."""
