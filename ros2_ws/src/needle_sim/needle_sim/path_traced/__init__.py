"""A needle of metal in a clear phantom as a path tracer shows it: stereo pairs with their truth."""
