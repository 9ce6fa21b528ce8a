"""What of a bag is played, when, and under which names."""
