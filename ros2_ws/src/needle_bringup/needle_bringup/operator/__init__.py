"""What the operator stand-in does, in which order."""
