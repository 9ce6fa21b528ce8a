"""Live view of the needle for ROS viewers."""
