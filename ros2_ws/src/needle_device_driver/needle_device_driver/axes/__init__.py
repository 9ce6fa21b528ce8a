"""What the motion supervisor asks of the axes, whatever moves them."""
