"""The needle for programs that speak OpenIGTLink, such as 3D Slicer."""
