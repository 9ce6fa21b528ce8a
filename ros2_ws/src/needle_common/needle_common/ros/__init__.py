"""What the rig's nodes share of ROS."""
