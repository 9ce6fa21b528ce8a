"""Motion supervisor of the insertion and rotation axes: states, limits, hold, stop."""
