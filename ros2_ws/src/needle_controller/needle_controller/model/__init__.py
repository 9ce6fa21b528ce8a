"""The model of the needle: kinematics, its linearisation, gains, reach, and the plane to follow."""
