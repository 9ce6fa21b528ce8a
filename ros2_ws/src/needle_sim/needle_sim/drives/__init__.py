"""Two emulated CiA 402 drives on a CAN bus; shares no code with the driver that it tests."""
