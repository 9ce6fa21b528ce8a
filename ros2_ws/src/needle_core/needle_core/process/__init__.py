"""A process' share of the machine: its end, its names, its folders, its ROS domain."""
