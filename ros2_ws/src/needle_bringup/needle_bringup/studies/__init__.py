"""Studies of controllers on simulated needles."""
