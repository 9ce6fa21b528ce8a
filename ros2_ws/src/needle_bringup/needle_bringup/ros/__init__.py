"""The operator's stand-in, and what the launch files share."""
