"""CANopen devices (CiA 301), and the CAN adapter of the emulated drives."""
