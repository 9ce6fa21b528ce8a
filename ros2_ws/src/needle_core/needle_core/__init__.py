"""Common ground of all nodes and commands of the rig: parameters, diagnostics, error exits."""
