"""A run, or two, as a page with figures."""
