"""Common ground of the rig's nodes in ROS."""
