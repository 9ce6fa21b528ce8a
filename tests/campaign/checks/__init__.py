"""Full-size checks of `scripts/verify`, by step."""
