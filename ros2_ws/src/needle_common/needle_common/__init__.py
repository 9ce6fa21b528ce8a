"""What every node and command of the rig shares: parameters, diagnostics, error exits."""
