"""The recorder's and the player's ROS side."""
