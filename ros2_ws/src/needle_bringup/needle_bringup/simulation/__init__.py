"""One simulated run: its nodes, their parameters, their end."""
