"""plane_controller's ROS side."""
