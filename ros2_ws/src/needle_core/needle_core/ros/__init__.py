"""ROS nodes of components, and the graph commands of the small `ros2`."""
