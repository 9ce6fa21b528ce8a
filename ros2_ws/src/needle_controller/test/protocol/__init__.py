"""The step protocol, transition by transition, without ROS."""
