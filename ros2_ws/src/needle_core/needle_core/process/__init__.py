"""Resources of a process: signals, names, ROS domain, discovery, shared memory, workers."""
