"""Files from outside: read within bounds, checked, and replaced whole."""
