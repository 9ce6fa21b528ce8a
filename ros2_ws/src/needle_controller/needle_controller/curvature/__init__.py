"""The curvature of the needle's path from tips of pure insertion."""
