"""ROS nodes of this package, and the common part of the launch files."""
