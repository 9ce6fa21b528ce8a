"""The rig as a whole: operators, simulate, launch files, configuration."""
