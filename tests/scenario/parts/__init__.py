"""Components of the soak besides the rig's own: bench, person, rogue nodes, page."""
