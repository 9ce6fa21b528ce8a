"""The driver's component on the emulated drives, in virtual time."""
