"""A person's pedal, key or joystick: from a device's bytes to the hold."""
