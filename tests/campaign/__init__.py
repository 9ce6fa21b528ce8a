"""Full-size checks of the steps of the project."""
