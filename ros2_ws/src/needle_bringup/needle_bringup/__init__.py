"""The rig as a whole: operator, recorder, report, launch files, configuration."""
