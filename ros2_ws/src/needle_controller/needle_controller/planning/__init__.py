"""Paths to a target point around obstacles, for a needle of given curvature and bounded turns."""
