"""Web console: shows the state of the rig, and has a hold to steer the needle."""
