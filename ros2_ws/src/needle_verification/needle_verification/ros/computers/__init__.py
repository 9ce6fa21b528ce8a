"""Trials of a rig on two computers: two network namespaces, and a bad cable between them."""
