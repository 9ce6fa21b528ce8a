"""Stands in for the rig: needle plant, tissue, stereo renderer, simulated axes."""
