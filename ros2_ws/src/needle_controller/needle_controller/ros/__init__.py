"""ROS executable of plane_controller."""
