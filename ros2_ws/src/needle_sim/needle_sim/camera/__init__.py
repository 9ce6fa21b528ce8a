"""Quick stereo renderer: images of a needle in a clear phantom."""
