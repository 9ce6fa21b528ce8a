"""What a person sees of a needle while it is steered: no ROS."""
