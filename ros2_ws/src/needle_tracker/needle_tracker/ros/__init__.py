"""ROS executables of the tracker and the cameras."""
