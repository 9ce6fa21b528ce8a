"""The tracker's and the cameras' ROS side."""
