"""What a person holds, and what may come of it: from a device's bytes to the hold."""
