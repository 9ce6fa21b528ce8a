"""Components of the soak beside the rig's own: bench, person, strangers, page."""
