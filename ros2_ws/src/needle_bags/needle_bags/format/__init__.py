"""rosbag2 directories with MCAP data: how they are written."""
