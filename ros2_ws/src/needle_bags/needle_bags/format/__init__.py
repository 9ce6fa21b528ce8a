"""Writing of rosbag2 directories with MCAP data."""
