"""A made-up drive, Tick, and its emulator."""
