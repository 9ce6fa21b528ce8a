"""OpenIGTLink server for programs such as 3D Slicer."""
