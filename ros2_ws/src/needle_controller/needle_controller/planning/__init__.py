"""Paths to a target point round obstacles, for a needle of given curvature and bounded turns."""
