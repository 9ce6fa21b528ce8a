"""Operator: hold-to-run switch of a pedal, key or joystick."""
