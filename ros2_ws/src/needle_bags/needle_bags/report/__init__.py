"""A run, or two, as a page: what it says, and in which words."""
