"""The rig as a whole: operator, simulate, launch files, configuration."""
