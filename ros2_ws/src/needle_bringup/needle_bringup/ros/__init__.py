"""The operator stand-in, and what the launch files share."""
