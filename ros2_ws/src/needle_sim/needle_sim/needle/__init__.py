"""Simulated needle: motion of its tip on SE(3), torsion in tissue, and visible shape."""
