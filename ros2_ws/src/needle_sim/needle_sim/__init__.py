"""Simulation of the rig: needle plant, tissue, stereo renderers, axes and drives."""
