"""The model of the needle: kinematics, its linearization, gains, reach, and the plane to follow."""
