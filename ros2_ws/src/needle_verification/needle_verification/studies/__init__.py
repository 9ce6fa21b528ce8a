"""Studies of tracker and controller over simulated needles."""
