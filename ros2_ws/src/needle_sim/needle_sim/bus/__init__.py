"""CANopen (CiA 301) as a device speaks it, and the emulated bus's adapters."""
