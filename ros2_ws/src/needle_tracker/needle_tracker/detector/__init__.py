"""One camera's image in, needle ends with their uncertainty out."""
