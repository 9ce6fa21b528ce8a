"""Interface of the motion supervisor to the axes, whatever moves them."""
