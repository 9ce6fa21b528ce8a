"""Studies of the controller over simulated needles."""
