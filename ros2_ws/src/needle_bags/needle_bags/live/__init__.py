"""Picture of a needle while it is steered: no ROS."""
