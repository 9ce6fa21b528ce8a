"""The needle on SE(3), in tissue."""
