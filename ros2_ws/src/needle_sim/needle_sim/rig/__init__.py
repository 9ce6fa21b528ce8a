"""The simulated bench and the time it runs on."""
