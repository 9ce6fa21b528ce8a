"""What each step must show, at full size."""
